"""Injected faults in the host: of its backend, and of its messages; recorded with their tick."""

from collections.abc import Sequence

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.faults.injector import Injector
from snakesim_hal.injection import HAL
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.wire.messages import LifecycleState

MAX_KEPT = 10_000


class HostFaults:
    """Injected faults of the host. Use `backend` instead of the original one."""

    def __init__(self, config: RunConfig, backend: Backend, session: Session) -> None:
        self.backend = FaultyBackend(backend)
        self.noted: list[str] = []
        self._period_ns = config.period_ns
        self._tick = 0
        self._injector = Injector(HAL, config, session, carry_out=self.backend.inject, note=self._note)

    def turn(self, stamp_ns: int, arming: int, lifecycle: LifecycleState) -> Sequence[str]:
        """Begin and end due faults, answer requests, and hang if requested. Returns planned ones that are refused."""
        self._tick = stamp_ns // self._period_ns
        return self._injector.turn(stamp_ns, arming, lifecycle)

    @property
    def on(self) -> list[str]:
        """Active faults."""
        return self._injector.on

    def idle(self) -> None:
        """Answer requests while no tick comes."""
        self._injector.idle()

    def close(self) -> None:
        """Drop delayed messages."""
        self._injector.close()

    def _note(self, text: str, _now_s: float) -> None:
        if len(self.noted) < MAX_KEPT:
            self.noted.append(f"tick {self._tick}: {text}")

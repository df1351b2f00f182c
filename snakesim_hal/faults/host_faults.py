"""Injected faults in the host: of its backend, and of its messages; recorded with their tick."""

from collections.abc import Sequence

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.faults.injector import Injector
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.wire.messages import LifecycleState

MAX_KEPT = 10_000


class HostFaults(Injector):
    """Injected faults of the host. Use `backend` instead of the original one."""

    def __init__(self, config: RunConfig, backend: Backend, session: Session) -> None:
        self.backend = FaultyBackend(backend)
        self._period_ns, self._tick = config.period_ns, 0
        super().__init__(HAL, config, session, carry_out=self.backend.inject)

    def turn(self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState) -> Sequence[str]:
        """As of any part, at a tick to be noted."""
        self._tick = timestamp_ns // self._period_ns
        return super().turn(timestamp_ns, arm_session, lifecycle)

    def _note(self, text: str, now_s: float) -> None:
        if len(self.noted) < MAX_KEPT:
            self.noted.append(f"tick {self._tick}: {text}")

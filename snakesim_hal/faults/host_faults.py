"""Injected faults in the host: of its backend, and of its messages; recorded with their tick."""

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.faults.injector import Injector, no_action
from snakesim_hal.model.injection import HAL
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.safety.authority import Authority
from snakesim_hal.wire.messages import Fault

MAX_KEPT = 10_000


class HostFaults:
    """Injected faults of the host. Use `backend` instead of the original one."""

    def __init__(self, config: RunConfig, backend: Backend, session: Session, authority: Authority) -> None:
        """Raises ConfigError when faults are planned where something real moves."""
        emulated = authority.description.emulated
        self.backend: Backend = backend
        self.noted: list[str] = []
        self._authority, self._period_ns = authority, config.period_ns
        self._tick = 0
        carry_out = no_action
        if emulated or config.faults_allowed:
            self.backend = faulty = FaultyBackend(backend)
            carry_out = faulty.inject
        self._injector = Injector(HAL, config, session, carry_out=carry_out, note=self._note, refused=self._refused)
        self._injector.allow(emulated=emulated, faults_allowed=config.faults_allowed)

    def turn(self, tick: int) -> None:
        """Begin and end due faults, answer requests, and hang if requested."""
        self._tick = tick
        self._injector.turn(tick * self._period_ns, self._authority.arming, self._authority.state)

    @property
    def on(self) -> list[str]:
        """Active faults."""
        return self._injector.on

    def close(self) -> None:
        """Drop delayed messages."""
        self._injector.close()

    def _note(self, text: str, _now_s: float) -> None:
        if len(self.noted) < MAX_KEPT:
            self.noted.append(f"tick {self._tick}: {text}")

    def _refused(self, text: str) -> None:
        self._authority.note(Fault(tick=self._tick, what="injection_refused", cause=text))

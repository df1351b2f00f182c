"""Carries out the injected faults of the host, in its backend and its messages, and records each with its tick."""

from collections.abc import Sequence

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.faults.injector import FaultInjector
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.wire.messages import LifecycleState

MAX_NOTES = 10_000  # so that the memory stays bounded, however long the run


class HostFaults(FaultInjector):
    """Carries out the injected faults of the host, in the host's thread. Use `backend` instead of the original one."""

    def __init__(self, config: RunConfig, backend: Backend, session: Session) -> None:
        """Wrap the host's backend, and declare the key on which the host receives requests for faults."""
        self.backend = FaultyBackend(backend)
        self._period_ns = config.period_ns
        self._tick = 0
        super().__init__(HAL, config, session, apply_fault=self.backend.inject)

    def update(
        self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState
    ) -> Sequence[str]:
        """Store the tick for `notes`, then update the faults as in every other part of a run."""
        self._tick = timestamp_ns // self._period_ns
        return super().update(timestamp_ns, arm_session, lifecycle)

    def _record_event(self, text: str, now_s: float) -> None:
        """Add the start or the end of a fault to `notes`, with its tick."""
        if len(self.notes) < MAX_NOTES:
            self.notes.append(f"tick {self._tick}: {text}")

"""Injected faults in one part of a robot: carried out where they are allowed, else refused.

They are allowed where nothing real moves, or by the scenario. Anywhere else the code that carries them out is not even
loaded: this module alone imports `snakesim_hal.faults`, and only when it is needed.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.fault_plan import planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Question, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Clock, Description, LifecycleState

HOW_TO_ALLOW = "something real moves here; to allow it set `allow_fault_injection = true` in the scenario"


class Faults(Protocol):
    """The injected faults of one part."""

    @property
    def on(self) -> Sequence[str]:
        """Active ones."""
        ...

    @property
    def noted(self) -> Sequence[str]:
        """Each begin and end, with its tick."""
        ...

    def turn(self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState, /) -> Sequence[str]:
        """At a tick: begin and end due faults, answer requests, and hang if requested. Returns planned ones refused."""
        ...

    def idle(self) -> None:
        """Answer requests while no tick comes."""
        ...

    def close(self) -> None:
        """Drop delayed messages."""
        ...


class NoFaults:
    """Refuses every request."""

    on: Sequence[str] = ()
    noted: Sequence[str] = ()

    def __init__(self, part: str, config: RunConfig, session: Session) -> None:
        """Raises ConfigError when some are planned."""
        if any(injection.part == part for injection in planned(config)):
            raise ConfigError(f"`faults` are planned, and {HOW_TO_ALLOW}; otherwise leave them out")
        self._lifecycle: LifecycleState = "disarmed"
        session.on_question(keys.fault(part), self._refuse)

    def turn(self, _timestamp_ns: int, _arm_session: int, lifecycle: LifecycleState, /) -> Sequence[str]:
        """None is planned."""
        self._lifecycle = lifecycle
        return ()

    def idle(self) -> None:
        """Requests are refused as they come."""

    def close(self) -> None:
        """No message is late."""

    def _refuse(self, question: Question) -> None:
        why = f"fault injection is not allowed: {HOW_TO_ALLOW}"
        question.reply(Answer(ok=False, reason=why, refusal="not_allowed", lifecycle=self._lifecycle))


def faults_of_host(config: RunConfig, backend: Backend, session: Session) -> tuple[Backend, Faults]:
    """The backend to use instead, and its faults. Raises ConfigError for planned ones that are forbidden."""
    if not _allowed(config, backend.describe()):
        return backend, NoFaults(HAL, config, session)
    from snakesim_hal.faults.host_faults import HostFaults

    faults = HostFaults(config, backend, session)
    return faults.backend, faults


def faults_of_service(
    name: str, config: RunConfig, session: Session, robot: Description, newest: Callable[[], Clock | None]
) -> Faults:
    """The faults of a service. newest: the newest clock. Raises ConfigError for planned ones that are forbidden."""
    if not _allowed(config, robot):
        return NoFaults(name, config, session)
    from snakesim_hal.faults.injector import Injector

    return Injector(name, config, session, newest=newest)


def _allowed(config: RunConfig, robot: Description) -> bool:
    return robot.emulated or config.allow_fault_injection

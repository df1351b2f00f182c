"""Chooses whether a part of a robot carries out injected faults, or refuses them.

They are allowed where nothing real moves, or by the scenario. Anywhere else the code that carries them out is not even
loaded: this module alone imports the rest of `snakesim_hal.faults`, and only when it is needed.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.fault_plan import parse_planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Clock, Description, LifecycleState

HOW_TO_ALLOW = "something real moves here; to allow it set `allow_fault_injection = true` in the scenario"


class Faults(Protocol):
    """The injected faults of one part. The part's own thread makes every call, once in each cycle of its loop."""

    @property
    def active(self) -> Sequence[str]:
        """Return the active faults as texts."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """Return the begin and the end of each fault as texts, with the tick."""
        ...

    def update(self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState, /) -> Sequence[str]:
        """Begin and end the faults that are due at a tick, answer requests, and hang if a fault requires it.

        Args:
            timestamp_ns: robot time of the tick.
            arm_session: of the robot's clock; 0: never armed.
            lifecycle: state of the robot.

        Returns:
            Planned faults that could not be carried out, with the reason.
        """
        ...

    def answer_requests(self) -> None:
        """Answer requests while no tick comes."""
        ...

    def close(self) -> None:
        """Drop delayed messages."""
        ...


class NoFaults:
    """Refuses every request."""

    active: Sequence[str] = ()
    notes: Sequence[str] = ()

    def __init__(self, part: str, config: RunConfig, session: Session) -> None:
        """Declare the part's key for requests.

        Raises:
            ConfigError: the run plans a fault of this part.
        """
        if any(injection.part == part for injection in parse_planned(config)):
            raise ConfigError(
                f"`faults` are planned, and {HOW_TO_ALLOW}; otherwise leave them out", code="injection/not-allowed"
            )
        self._lifecycle: LifecycleState = "disarmed"
        session.on_query(keys.fault_key(part), self._refuse)

    def update(self, _timestamp_ns: int, _arm_session: int, lifecycle: LifecycleState, /) -> Sequence[str]:
        self._lifecycle = lifecycle
        return ()

    def answer_requests(self) -> None:
        """Do nothing: Zenoh's thread refuses requests as they arrive."""

    def close(self) -> None:
        """Do nothing: no message is delayed."""

    def _refuse(self, question: Query) -> None:
        """Refuse a request, in Zenoh's thread."""
        why = f"fault injection is not allowed: {HOW_TO_ALLOW}"
        question.reply(Answer(ok=False, reason=why, refusal="not_allowed", lifecycle=self._lifecycle))


def create_host_faults(config: RunConfig, backend: Backend, session: Session) -> tuple[Backend, Faults]:
    """Return the backend that the host should use, and the faults of the host.

    Raises:
        ConfigError: the run plans a fault of the host, and faults are not allowed here.
    """
    if not _allowed(config, backend.describe()):
        return backend, NoFaults(HAL, config, session)
    from snakesim_hal.faults.host_faults import HostFaults

    faults = HostFaults(config, backend, session)
    return faults.backend, faults


def create_service_faults(
    name: str, config: RunConfig, session: Session, robot: Description, newest: Callable[[], Clock | None]
) -> Faults:
    """Return the faults of a service.

    Args:
        name: of the service.
        config: of the run.
        session: of the service.
        robot: description of the robot.
        newest: returns the newest clock, also while the service hangs.

    Raises:
        ConfigError: the run plans a fault of this service, and faults are not allowed here.
    """
    if not _allowed(config, robot):
        return NoFaults(name, config, session)
    from snakesim_hal.faults.injector import Injector

    return Injector(name, config, session, newest=newest)


def _allowed(config: RunConfig, robot: Description) -> bool:
    return robot.emulated or config.allow_fault_injection

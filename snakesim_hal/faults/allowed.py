"""Chooses whether a part of a robot carries out injected faults, or refuses them.

They are allowed where nothing real moves, or by the scenario. Anywhere else the code that carries them out is not even
loaded: this module alone imports the rest of `snakesim_hal.faults`, and only when it is needed.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Clock, LifecycleState, RobotDescription

HOW_TO_ALLOW = (
    "something real moves here; to allow it set `allow_fault_injection = true` in the scenario"
)


class InjectedFaults(Protocol):
    """The injected faults of one part. The part's own thread makes every call, once in each cycle of its loop."""

    @property
    def active(self) -> Sequence[str]:
        """Return the active faults as texts."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """Return the start and the end of each fault as texts, with the tick."""
        ...

    def update(
        self, timestamp_ns: int, arm_session: int, lifecycle: LifecycleState, /
    ) -> Sequence[str]:
        """Start and end the faults that are due at a tick, answer requests, and hang if a fault requires it.

        Args:
            timestamp_ns: Robot time of the tick.
            arm_session: Number of the arm session from the robot's clock. 0 if the robot was never armed.
            lifecycle: Lifecycle state of the robot.

        Returns:
            Texts about planned faults that could not be started or ended since the last call, each with the reason.
        """
        ...

    def answer_requests(self) -> None:
        """Answer requests while no tick comes."""
        ...

    def close(self) -> None:
        """Drop delayed messages."""
        ...


class NoFaults:
    """The faults of a part in which fault injection is not allowed: every request is refused."""

    active: Sequence[str] = ()
    notes: Sequence[str] = ()

    def __init__(self, part: str, config: RunConfig, session: Session) -> None:
        """Declare the key on which the part receives requests for faults.

        Raises:
            ConfigError: The run has a planned fault of this part.
        """
        if any(injection.executing_part == part for injection in parse_planned_faults(config)):
            raise ConfigError(
                f"`faults` are planned, and {HOW_TO_ALLOW}; otherwise leave them out",
                code="injection/not-allowed",
            )
        self._lifecycle: LifecycleState = "disarmed"
        session.on_query(keys.fault_key(part), self._refuse_request)

    def update(
        self, _timestamp_ns: int, _arm_session: int, lifecycle: LifecycleState, /
    ) -> Sequence[str]:
        self._lifecycle = lifecycle
        return ()

    def answer_requests(self) -> None:
        """Do nothing: Zenoh's thread refuses requests as they arrive."""

    def close(self) -> None:
        """Do nothing: no message is delayed."""

    def _refuse_request(self, query: IncomingQuery) -> None:
        """Refuse a request, in Zenoh's thread."""
        reason = f"fault injection is not allowed: {HOW_TO_ALLOW}"
        query.reply(
            Answer(ok=False, reason=reason, refusal="not_allowed", lifecycle=self._lifecycle)
        )


def create_host_faults(
    config: RunConfig, backend: Backend, session: Session
) -> tuple[Backend, InjectedFaults]:
    """Return the backend that the host should use, and the object that injects faults into the host.

    Args:
        config: Run configuration.
        backend: Backend of the run. If faults are allowed, it is wrapped so that faults of joints can be injected.
        session: Network session of the host.

    Raises:
        ConfigError: The run has a planned fault of the host, but fault injection is not allowed.
    """
    if not _are_faults_allowed(config, backend.describe()):
        return backend, NoFaults(HAL, config, session)
    from snakesim_hal.faults.host_faults import HostFaults

    faults = HostFaults(config, backend, session)
    return faults.backend, faults


def create_service_faults(
    name: str,
    config: RunConfig,
    session: Session,
    robot: RobotDescription,
    read_newest_clock: Callable[[], Clock | None],
) -> InjectedFaults:
    """Return the object that injects faults into a service, or one that refuses all faults if they are not allowed.

    Args:
        name: Name of the service.
        config: Run configuration.
        session: Network session of the service.
        robot: Description of the robot.
        read_newest_clock: Function that returns the newest clock message, also while the service hangs.

    Raises:
        ConfigError: The run has a planned fault of this service, but fault injection is not allowed.
    """
    if not _are_faults_allowed(config, robot):
        return NoFaults(name, config, session)
    from snakesim_hal.faults.injector import FaultInjector

    return FaultInjector(name, config, session, read_newest_clock=read_newest_clock)


def _are_faults_allowed(config: RunConfig, robot: RobotDescription) -> bool:
    """Return whether faults may be injected: nothing real moves, or the configuration allows them."""
    return robot.emulated or config.allow_fault_injection

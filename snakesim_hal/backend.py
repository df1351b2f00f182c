"""The interface of a backend: a robot, simulated or real.

`Backend` is the base class of every backend. This file shows each of its members with its arguments, their units, when
it is called, by which thread, and how long it may take. A backend never uses Zenoh or leases: the host handles those,
for every backend alike.

Call order
    Before a run, on the class alone: `Settings`, `supported_modes` or `limit_modes`, then `check`. They open nothing.
    To start: the constructor, then `describe`.
    In every control cycle: `sample`, `enact`, `advance`, `faults`. Until the robot is armed for the first time in
    lockstep, the host may repeat a tick.
    At any time between two of these calls: `describe`, `inject`.
    To end: `close`, also after an error.

Threads
    One thread, that of the host, makes all calls. No two calls overlap, so a backend without threads needs no lock.

Time
    `sample`, `enact`, `advance` and `faults` together may take up to four fifths of a control period. The host measures
    them. If they take longer, `snakesim status` names the backend with the rate that it could hold, and the robot is
    not armed. The rest of the period is for the controller. The host waits for the next period itself, so that a
    backend need not sleep.

Errors
    An exception of any call ends the run safely: the host reports it as a latched fault `backend_failed`, calls `close`
    and keeps the record. Raise `BackendError` with a message that explains what to do, and `ConfigError` for a
    value of the configuration. An exception of another class is reported with the name of the call.

Units are SI, and vectors have one entry for each joint, from tail to head.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import msgspec

from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.robot_file.joints import DriveMode
from snakesim_hal.model.robot_file.robot import RobotFile, restrict_drive_modes
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.codec import EncodedMessage
from snakesim_hal.wire.messages import (
    ClockMode,
    Fault,
    JointMode,
    JointState,
    LifecycleState,
    Message,
    RobotDescription,
)


@dataclass(frozen=True)
class SafeSetpoints:
    """Setpoints of all joints that have passed the limiter. They hold until the next ones.

    Only the limiter creates them, so the type checker proves that no backend gets setpoints that were not limited.
    Controllers return `snakesim_hal.wire.setpoints.RequestedSetpoints` instead.
    """

    mode: list[JointMode]  # of each joint
    target: list[float]  # rad, rad/s or N·m, depending on the mode
    torque_limit_nm: list[float]  # maximum torque of each joint's motor
    # Indices of isolated joints, which are passive here and to be switched off.
    isolated: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Samples:
    """Sensor samples of one tick. Besides the joint state they contain only samples that were due."""

    joints: JointState  # in every tick
    # Of the other sensors, by key.
    by_key: Mapping[str, Message] = field(default_factory=dict[str, Message])
    # Encoded `by_key`, filled in by the host.
    encoded_by_key: Mapping[str, EncodedMessage] = field(default_factory=dict[str, EncodedMessage])


class Backend(ABC):
    """A robot, simulated or real. Derive from it, and implement the abstract methods.

    The members above the constructor belong to the class: they are used before a run, when no backend is open.
    """

    # The scenario's `[backends.<name>]` section (may be an empty Struct).
    Settings: ClassVar[type[msgspec.Struct]]
    # Of every joint (None: those of the robot file).
    supported_modes: ClassVar[Collection[DriveMode] | None] = None

    @classmethod
    def check(cls, config: RunConfig, settings: Any) -> tuple[ClockMode, ...]:
        """Check a configuration, and return the clock modes that are possible with it.

        Called before anything starts, perhaps on a computer without the robot, and perhaps several times. Opens
        nothing. May take a second.

        Args:
            config: The run, with a robot that has only the modes of this backend.
            settings: An instance of `Settings`.

        Returns:
            The possible clock modes, the preferred one first. The default is real time alone, as for a real robot. A
            simulation can also wait for slow services: "lockstep", and run faster than real time: "free".

        Raises:
            ConfigError: This backend supports the run in no clock mode. The run does not start.
        """
        del config, settings
        return ("realtime",)

    @classmethod
    def limit_modes(cls, robot: RobotFile) -> RobotFile:
        """Return the robot with only those control modes that its joints have on this backend.

        Called before `check`. The default applies `supported_modes` to all joints alike. Override it only if joints
        differ. A controller that needs a mode that a joint does not have is refused before the run.

        Args:
            robot: The robot as its file describes it.

        Raises:
            ConfigError: The backend cannot drive this robot.
        """
        if cls.supported_modes is None:
            return robot
        return restrict_drive_modes(robot, cls.supported_modes)

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Open the robot. No motor is switched on. May take seconds or minutes.

        Args:
            config: The run that `check` has accepted, in one of the clock modes that it returned.
            settings: An instance of `Settings`.

        Raises:
            BackendError: A device is missing or does not answer. Whatever was opened is closed again, because the host
                cannot call `close` without an object.
        """
        del config, settings

    @abstractmethod
    def describe(self) -> RobotDescription:
        """Return the description of the robot: the same one at every call, at once.

        `describe_robot` in `snakesim_hal.model.robot_file.robot` makes it from the robot file. It lists exactly those
        sensors whose samples `sample` returns.
        """

    @abstractmethod
    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Read the joints, and every other sensor that is due.

        A joint that does not answer keeps its last values with a growing `age_ns`, or is not `valid`. That is no error.

        Args:
            tick: Number of the control cycle, which goes into every sample.
            timestamp_ns: The robot's time, which goes into every sample that was measured now.

        Raises:
            BackendError: There is no valid state any more. The run ends.
        """

    @abstractmethod
    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Hand setpoints to the motors. They hold until the next call.

        The setpoints are safe in every state, so a simulator needs no more. A robot whose drives have states of their
        own makes them follow `lifecycle`.

        Args:
            setpoints: Setpoints within every limit. Isolated joints are passive in them.
            lifecycle: "armed": drives may be switched on. "fault": drives that follow continue, to brake. No other is
                switched on. "disarmed" and "estop": all drives are off.

        Raises:
            BackendError: The setpoints cannot be sent. The run ends.
        """

    @abstractmethod
    def advance(self) -> None:
        """Let one control period pass: a simulator steps, a driver sends and receives, without sleeping.

        Raises:
            BackendError: The robot cannot continue. The run ends.
        """

    def faults(self) -> list[Fault]:
        """Return the faults that were detected since the last call, each once until the operator's reset.

        A fault with `scope="joint"` isolates its joint if the robot file allows that. One with `scope="none"` is only
        noted. Any other stops the robot. The default is a robot that detects none.
        """
        return []

    def list_arming_obstacles(self) -> list[str]:
        """Return why the robot cannot be armed now, a sentence each; empty if nothing of the backend is against it.

        Called in every control cycle after `sample`. For what is no fault, such as a drive that still looks for its
        zero. The default is empty.
        """
        return []

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Begin or end an injected fault, where the backend can do so more realistically than the host.

        Called between two control cycles, and only if the robot is emulated or the scenario allows it.

        Args:
            injection: The fault.
            begins: True to begin it, False to end it.

        Returns:
            False if this backend does not have this fault: the host then changes samples instead, if it can. This is
            the default.

        Raises:
            ConfigError: The fault cannot be injected into this robot. It is refused, and the run continues.
        """
        del injection, begins
        return False

    @abstractmethod
    def close(self) -> None:
        """Switch off all motors, and release all resources. May take seconds.

        Called once by the host, also after an error. A second call does nothing. Afterwards no call moves anything:
        each returns or raises BackendError.
        """

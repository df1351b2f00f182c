"""The interface of a controller: one observation of the robot each tick in, setpoints for every joint out.

`Controller` is the base class of every controller, shipped or third-party. `Observation` is what it gets each tick, and
`ControllerCommand` what it returns. `load_controller` finds the class that a configuration names.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, TypeVar

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import ConfigTable, FileStruct, decode_table
from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.plugins import CONTROLLERS, describe_plugin, load_plugin, require_base_class
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, WaypointGoal, compute_start_pose
from snakesim_hal.wire.messages import (
    JointMode,
    JointState,
    Measurement,
    Message,
    RobotDescription,
    Trajectory,
    WorldContact,
    WorldModel,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints


@dataclass(frozen=True)
class Task:
    """The start pose and the goal of a scenario."""

    start_position_w: tuple[float, float, float]  # m, of the tail end
    start_wxyz: tuple[float, float, float, float]  # orientation of the tail link
    goal: HeadingGoal | WaypointGoal | None  # None: the scenario has no goal

    @staticmethod
    def from_config(config: RunConfig) -> "Task":
        """Return the task of a run."""
        start = compute_start_pose(config)
        x, y = start.position_w
        return Task(
            (x, y, config.robot.module.radius_m),
            quaternion_from_yaw(start.yaw_rad),
            config.mission.goal,
        )


@dataclass(frozen=True)
class SensorSamples:
    """Samples as the sensors published them, and the task. Only for controllers with `uses_sensors = True`."""

    # Newest sample of `sensor/pose` and `sensor/contacts`, by key (absent: none yet).
    newest: Mapping[str, Message]
    # Key -> why its newest sample is too old to be used (fresh ones are left out).
    late: Mapping[str, str]
    task: Task  # where the robot started, and its goal


@dataclass(frozen=True)
class Observation:
    """The inputs of a controller at one tick. All times are times of the robot, not of the computer."""

    tick: int  # number of the control cycle
    time_s: float  # since arming (also across new parameters, which replace the controller in an arm session)
    period_s: float  # of the control cycle
    joints: JointState  # angles, velocities and torques, tail to head, always fresh
    # Pose, contacts and obstacles (None: there is none yet, or it is too old).
    world: WorldModel | None
    trajectory: Trajectory | None  # path and speed (None: there is none yet, or it is too old)
    # None: the controller does not declare `uses_sensors`.
    sensor_samples: SensorSamples | None = None


@dataclass(frozen=True)
class Telemetry:
    """What a controller reports of itself. All fields are optional. `control/state` and the run's report show them."""

    reason: str = ""  # what prevents motion, such as a jam (empty: nothing does)
    reason_if_stationary: str = ""  # the cause to report if the body turns out not to move
    usable_push_points: int | None = None  # None: this controller does not push off obstacles
    path_s_m: float | None = None  # arc length of the tail end on the path
    propulsion_joint: int | None = None  # index of the joint that pushes, from the tail
    propulsion_n: float | None = None  # desired force along the path
    push_points: Sequence[WorldContact] = ()  # the contacts that it pushes off
    desired_force_n: Sequence[float] = ()  # at each push-point
    propulsion_torque_nm: float | None = None  # of the joint that pushes
    bending_torque_nm: Sequence[float] = ()  # (n_joints,)
    reference_rad: Sequence[float] = ()  # (n_joints,) angles that the controller wants
    condition: float | None = None  # condition number of the equations that it solved
    torque_headroom_nm: float | None = None  # between the largest torque and its limit
    saturated: bool = False  # the push is at its torque limit
    jammed: bool = False  # the body is stuck although a joint pushes

    custom: Mapping[str, float] = field(default_factory=dict[str, float])
    """Up to 32 numbers of your own, by names that end in their unit, such as `amplitude_rad`.

    Results, exports and plots have them as `amplitude_rad.controller`.
    """


@dataclass(frozen=True)
class ControllerCommand:
    """What a controller returns for one tick."""

    setpoints: RequestedSetpoints  # in the order of `robot.joints`, tail to head
    telemetry: Telemetry = field(default_factory=Telemetry)  # for `control/state` and the report


class NoParameters(FileStruct, frozen=True):
    """The parameters of a controller that has none."""


ParametersT = TypeVar("ParametersT", bound=msgspec.Struct)


class Controller(ABC, Generic[ParametersT]):
    """Base class of all controllers: each tick it turns one observation into a setpoint for every joint.

    A controller that swings all joints about the pose that they have at arming, with one parameter:

        class SwingParameters(snakesim.Parameters, frozen=True):
            amplitude_rad: float = 0.2


        class Swing(snakesim.Controller[SwingParameters]):
            Parameters = SwingParameters
            needs_world = False

            def __init__(self, robot, parameters):
                super().__init__(robot, parameters)
                self.start_rad = None

            def update(self, observation):
                if self.start_rad is None:
                    self.start_rad = observation.joints.angle_rad
                swing_rad = self.parameters.amplitude_rad * math.sin(observation.time_s)
                angles_rad = [start_rad + swing_rad for start_rad in self.start_rad]
                return snakesim.ControllerCommand(snakesim.make_position_setpoints(self.robot, angles_rad))

    Run it with `--controller ./swing.py:Swing`, or name the class in an entry point of the group
    `snakesim.controllers`. Every class attribute below is a declaration that a subclass may override. Those that it
    does not override keep their defaults.

    Life cycle: before the run, the declarations are compared with the robot, and `check` is called. The control process
    constructs a new object in the first control cycle after every arming, and when an operator changes a parameter of
    the running controller. It then calls `update` once in each control cycle, while the robot is armed and control
    holds the command lease. After a disarming, a fault or an emergency stop it drops the object without a further call.
    It makes all calls in one thread.

    A controller needs no clock and no I/O: all that it may use is in its arguments. The same observations then give the
    same commands in a simulation, on hardware and in a replay.
    """

    Parameters: ClassVar[type[msgspec.Struct]] = NoParameters
    """The Struct of the controller's parameters, which a scenario's section `[controllers.NAME]` sets.

    On the command line, `--set control.PARAMETER=VALUE` sets one of them.

    Each field needs a type. A default, bounds and a unit are recommended. `snakesim param` changes the values while the
    controller runs. Derive it from `snakesim.Parameters`, which refuses unknown names.
    """

    needs_world: ClassVar[bool] = True
    """Whether the controller needs `Observation.world`.

    False: it works with the joints alone, so it also runs on a robot without a pose sensor, and there without guidance
    and navigation.
    """

    required_modes: ClassVar[tuple[JointMode, ...]] = ()
    """Control modes that every joint must support, such as `(Mode.POSITION, Mode.TORQUE)`.

    A run on a robot without them is refused before it begins.
    """

    required_measurements: ClassVar[tuple[Measurement, ...]] = ()
    """Quantities besides angle and velocity that every joint must measure, such as `("torque",)`.

    A run on a robot without them is refused before it begins.
    """

    uses_sensors: ClassVar[bool] = False
    """Whether observations have `sensor_samples`: the newest samples of the pose and contact sensors, and the task."""

    @classmethod
    def check(cls, robot: RobotDescription, parameters: ParametersT) -> None:
        """Check before a run that this robot can be driven with these parameters. The default accepts everything.

        It is called before anything moves, in the process that starts the run, and possibly more than once. No object
        is constructed for it.

        Args:
            robot: Description of the robot.
            parameters: The parameters as configured. Their types and bounds are checked already.

        Raises:
            ConfigError: The robot and the parameters do not agree. The text names the parameter, its value and what is
                allowed.
        """

    def __init__(self, robot: RobotDescription, parameters: ParametersT) -> None:
        """Keep the arguments as `self.robot` and `self.parameters`. A subclass with state calls this first.

        The robot is armed already, so a constructor must return within a few control cycles. It must not have side
        effects: control also constructs an object to test a change of parameters, and drops it again.

        Args:
            robot: Description of the robot. Its joints are in the order tail to head.
            parameters: An object of `Parameters`.

        Raises:
            ConfigError: The parameters do not fit the robot. At an arming, this ends the run.
        """
        self.robot = robot
        self.parameters = parameters

    @abstractmethod
    def update(self, observation: Observation) -> ControllerCommand:
        """Return the setpoints for the next control cycle.

        The first observation after an arming shows the joints where they are, so that a controller can start from the
        measured pose. `observation.world` and `observation.trajectory` may be None at any tick, also in the middle of
        a run: a controller that needs them holds the pose meanwhile, and resumes without a jump. If the joint states
        are too old, `update` is not called at all, and the robot is stopped when the command lease expires.

        It must return within `observation.period_s` in real time. The setpoints are limited after it, by the command
        limiter of the HAL. An exception, or a command that cannot be sent, ends the run. The error names the class, the
        field and the value.

        Args:
            observation: The inputs of this tick.

        Returns:
            One mode, target (rad, rad/s or N·m, by the mode) and torque limit (N·m) for each joint, tail to head.
        """


def load_controller(name: str) -> type[Controller[Any]]:
    """Return the class of a controller by its name; a file is loaded, which runs its code. Raises ConfigError."""
    return require_base_class(
        load_plugin(CONTROLLERS, name), Controller, f"controller {shorten(name)!r}"
    )


def decode_parameters(
    controller: type[Controller[Any]],
    section: dict[str, Any],
    source: str,
    section_key: str,
    origin_by_key: dict[str, str] | None = None,
) -> Any:
    """Decode and check the parameters of a controller from a section of a configuration or of a request.

    Args:
        controller: Class of the controller, whose `Parameters` checks the values.
        section: Values as read.
        source: File or request that the values come from, for errors.
        section_key: Dotted key of the section, for errors.
        origin_by_key: File or flag that sets a dotted key, as far as it is known. None if it is not known for any key.

    Returns:
        An object of `controller.Parameters`.

    Raises:
        ConfigError: A value is not allowed, or `Parameters` is not a Struct.
    """
    if not (
        isinstance(controller.Parameters, type)
        and issubclass(controller.Parameters, msgspec.Struct)
    ):
        raise ConfigError(
            f"{describe_plugin(controller)}: `Parameters` is {shorten(repr(controller.Parameters))}, must be a class "
            "that derives from snakesim.Parameters"
        )
    return decode_table(
        ConfigTable(section, source, origin_by_key or {}), controller.Parameters, section_key
    )


def is_motion_requested(observation: Observation) -> bool:
    """Return whether world and trajectory are known, and the requested speed is not 0. Otherwise a controller holds."""
    return (
        observation.world is not None
        and observation.trajectory is not None
        and observation.trajectory.speed_m_s != 0.0
    )


def make_position_setpoints(
    robot: RobotDescription, angles_rad: Sequence[float]
) -> RequestedSetpoints:
    """Return setpoints that move every joint to an angle in position mode, with its full torque.

    Args:
        robot: Description of the robot.
        angles_rad: (n_joints,) tail to head.
    """
    return RequestedSetpoints(
        [JointMode.POSITION] * len(robot.joints),
        [float(angle) for angle in angles_rad],
        [joint.torque_limit_nm for joint in robot.joints],
    )

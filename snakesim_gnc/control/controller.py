"""The interface of a controller: settings in, then a view of the world each tick, setpoints out. No clock, no I/O.

A controller is a class with a `Settings` Struct, a constructor that takes the robot and the settings, and `update`.
It is created again at every arming, and called once a tick while the robot is armed. Any view may lack the world or the
trajectory, also during a run: then it must not push, but hold, and resume without a jump when they are back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, WaypointGoal, find_start_pose
from snakesim_hal.wire.messages import Description, JointState, Message, Mode, Trajectory, World, WorldContact
from snakesim_hal.wire.setpoints import RequestedSetpoints


@dataclass(frozen=True)
class Task:
    """Where a scenario lays the robot down, and where it wants it to go."""

    start_position_w: tuple[float, float, float]  # of the tail end
    start_wxyz: tuple[float, float, float, float]
    goal: HeadingGoal | WaypointGoal | None

    @staticmethod
    def of(config: RunConfig) -> "Task":
        """That of a run."""
        start = find_start_pose(config)
        x, y = start.position_w
        return Task((x, y, config.robot.module.radius_m), quaternion_from_yaw(start.yaw_rad), config.mission.goal)


@dataclass(frozen=True)
class Senses:
    """What a controller with SENSES = True gets besides: samples as the sensors gave them, and its task."""

    newest: Mapping[str, Message]  # of `sensor/pose` and `sensor/contacts`, by key; absent: none has come yet
    late: Mapping[str, str]  # key -> why its sample must not be used any more
    task: Task


@dataclass(frozen=True)
class View:
    """The inputs of a controller at one tick."""

    tick: int
    time_s: float  # since arming, by the robot's clock
    period_s: float
    joints: JointState
    world: World | None  # None: there is none yet, or it is too old; also for the trajectory
    trajectory: Trajectory | None
    senses: Senses | None = None  # None: the controller did not ask for them


@dataclass(frozen=True)
class Report:
    """A controller's own report; all fields are optional, and shown in `control/state` and in the run's report."""

    why: str = ""
    why_if_still: str = ""  # likewise, if the body should turn out not to move
    usable_push_points: int | None = None  # None: this controller does not push off obstacles
    path_s_m: float | None = None
    propulsion_joint: int | None = None
    propulsion_n: float | None = None
    push_points: Sequence[WorldContact] = ()
    desired_force_n: Sequence[float] = ()
    propulsion_torque_nm: float | None = None
    bending_torque_nm: Sequence[float] = ()
    reference_rad: Sequence[float] = ()
    condition: float | None = None
    torque_headroom_nm: float | None = None
    saturated: bool = False
    jammed: bool = False


@dataclass(frozen=True)
class Action:
    """A controller's answer to a view."""

    setpoints: RequestedSetpoints
    report: Report = field(default_factory=Report)


class Controller(Protocol):
    """The object of an entry point in the group `snakesim.controllers`, or of `./file.py:Name`."""

    Settings: type[msgspec.Struct]  # the scenario's [control] section
    # It may have NEEDS = "joints": it asks for no world, and so runs on a robot without a pose sensor; and what it
    # needs of every joint, or a run does not begin: MODES = (Mode.POSITION, Mode.TORQUE), MEASURES = ("torque",).
    # SENSES = True: its views have `senses`. A static method `check(robot, settings)` is called before a run begins,
    # and raises ConfigError for settings that this robot cannot be driven with.

    def __init__(self, robot: Description, settings: Any) -> None: ...

    def update(self, view: View) -> Action:
        """RequestedSetpoints for the next period, in the order of `robot.joints`."""
        ...


def motion_wanted(view: View) -> bool:
    """Whether there is a path, a speed along it, and a world to move in; without them a controller holds."""
    return view.world is not None and view.trajectory is not None and view.trajectory.speed_m_s != 0.0


def positions(robot: Description, angles_rad: Sequence[float]) -> RequestedSetpoints:
    """Every joint to an angle, tail to head, with its full torque."""
    return RequestedSetpoints(
        [Mode.POSITION] * len(robot.joints),
        [float(angle) for angle in angles_rad],
        [joint.torque_limit_nm for joint in robot.joints],
    )

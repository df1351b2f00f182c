"""The observation of a learned policy: groups of numbers with names, units and bounds, from the robot's own sensors.

Environments and the controller `policy` both read it here, so that a policy observes what it observed in training.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.goal_progress import GoalProgress
from snakesim_hal.base.errors import ConfigError, suggest_word
from snakesim_hal.controller import Observation
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Description, Message, Pose

# Bounds of an observation. They are generous: a value outside is clipped.
MAX_ANGLE_RAD = 2 * math.pi
MAX_FORCE_N = 1000.0
MAX_DISTANCE_M = 1000.0
MAX_SPEED_M_S = 10.0
MAX_TURN_RAD_S = 100.0
MAX_TIME_S = 1e5

# Ratios of these bounds to the limits of the motors.
SPEED_MARGIN = 3.0  # loads turn joints faster than motors do
TORQUE_MARGIN = 1.5  # torque sensors have noise

Read = Callable[[Observation, GoalProgress], Sequence[float]]


@dataclass(frozen=True)
class ObservationPart:
    """A group of numbers in an observation, such as the angles of all joints."""

    names: Sequence[str]
    unit: str
    low: Sequence[float]
    high: Sequence[float]
    read: Read
    sensor: str | None = None  # key of the sensor that it needs besides the joints


def _symmetric(
    names: Sequence[str], unit: str, maximum: float | Sequence[float], read: Read, sensor: str | None = None
) -> ObservationPart:
    """Return a part whose numbers are bounded by -maximum and maximum; one maximum for all numbers, or one for each."""
    high = [maximum] * len(names) if isinstance(maximum, int | float) else list(maximum)
    low = [-value for value in high]
    return ObservationPart(names, unit, low, high, read, sensor)


def make_parts(robot: Description) -> dict[str, ObservationPart]:
    """Return all parts that a robot with every sensor can observe, by name."""
    return _joint_parts(robot) | _goal_parts() | _contact_parts(robot) | _pose_parts()


def _joint_parts(robot: Description) -> dict[str, ObservationPart]:
    """Return the time and what the joints measure."""
    joints = robot.joints
    names = [joint.name for joint in joints]
    angles_rad = [max(MAX_ANGLE_RAD, -joint.angle_min_rad, joint.angle_max_rad) for joint in joints]
    speeds_rad_s = [SPEED_MARGIN * joint.speed_limit_rad_s for joint in joints]
    torques_nm = [TORQUE_MARGIN * joint.torque_limit_nm for joint in joints]
    return {
        "time_s": ObservationPart(
            ["since_arming"], "s", [0.0], [MAX_TIME_S], lambda observation, _: [observation.time_s]
        ),
        "angle_rad": _symmetric(names, "rad", angles_rad, lambda observation, _: observation.joints.angle_rad),
        "velocity_rad_s": _symmetric(
            names, "rad/s", speeds_rad_s, lambda observation, _: observation.joints.velocity_rad_s
        ),
        "torque_nm": _symmetric(names, "N·m", torques_nm, lambda observation, _: observation.joints.torque_nm),
    }


def _goal_parts() -> dict[str, ObservationPart]:
    """Return the bearing of the goal from the body's heading, and the distance that is left."""
    return {
        "goal_bearing": _symmetric(["cos", "sin"], "1", 1.0, _read_bearing, keys.POSE),
        "goal_m": ObservationPart(
            ["left"], "m", [0.0], [MAX_DISTANCE_M], lambda _, progress: [progress.left_m], keys.POSE
        ),
    }


def _contact_parts(robot: Description) -> dict[str, ObservationPart]:
    """Return the size of the contact force on every link."""
    names = [link.name for link in robot.links]
    count = len(names)
    low = [0.0] * count
    high = [MAX_FORCE_N] * count
    return {
        "contact_n": ObservationPart(
            names, "N", low, high, lambda observation, _: _read_forces(observation, count), keys.CONTACTS
        )
    }


def _pose_parts() -> dict[str, ObservationPart]:
    """Return what the pose sensor measures, in the world frame."""
    axes = ["x", "y", "z"]
    return {
        "position_w_m": _symmetric(axes, "m", MAX_DISTANCE_M, lambda _, progress: progress.pose[0], keys.POSE),
        "orientation_wxyz": _symmetric(["w", "x", "y", "z"], "1", 1.0, lambda _, progress: progress.pose[1], keys.POSE),
        "velocity_w_m_s": _symmetric(axes, "m/s", MAX_SPEED_M_S, _read_velocity, keys.POSE),
        "angular_velocity_w_rad_s": _symmetric(axes, "rad/s", MAX_TURN_RAD_S, _read_angular_velocity, keys.POSE),
    }


DEFAULT = ("angle_rad", "velocity_rad_s", "torque_nm", "goal_bearing", "goal_m", "contact_n")


def select_parts(robot: Description, observe: Sequence[str] | None) -> dict[str, ObservationPart]:
    """Return the parts that make up the observation of a policy, by their names.

    Args:
        robot: the robot that observes.
        observe: names of the parts, in their order; None: those in DEFAULT that the robot has sensors for.

    Returns:
        The parts by name, in the order of `observe`.

    Raises:
        ConfigError: there is no part of that name, or the robot does not have its sensor.
    """
    parts = make_parts(robot)
    sensors = {sensor.key for sensor in robot.sensors}
    observable = {name: part for name, part in parts.items() if part.sensor is None or part.sensor in sensors}
    if observe is None:
        return {name: observable[name] for name in DEFAULT if name in observable}
    if isinstance(observe, str) or not observe:
        raise ConfigError(
            f"observe={observe!r:.60}: give a sequence of names, such as ('angle_rad', 'contact_n')",
            code="policy/invalid",
        )
    for name in observe:
        if name not in parts:
            hint = suggest_word(str(name), parts)
            raise ConfigError(
                f"observe: no part {name!r:.60}; {hint}there are {', '.join(parts)}", code="policy/invalid"
            )
        if name not in observable:
            raise ConfigError(
                f"observe: {name!r} needs {parts[name].sensor}, which robot {robot.robot!r} has not",
                code="policy/invalid",
            )
    return {name: parts[name] for name in observe}


class Observer:
    """Makes the observation of an episode, tick by tick."""

    def __init__(self, robot: Description, parts: Mapping[str, ObservationPart]) -> None:
        """Start an episode.

        Args:
            robot: the robot that observes.
            parts: the parts of the observation as `chosen` returns them.
        """
        self._robot = robot
        self._parts = parts
        self._progress: GoalProgress | None = None  # None: there has been no observation yet

        # Sensors that the parts need, by key, and the bounds of the observation.
        self.sensors = {part.sensor for part in parts.values() if part.sensor is not None}
        low = [value for part in parts.values() for value in part.low]
        high = [value for part in parts.values() for value in part.high]
        self.low: NDArray[np.float32] = np.array(low, np.float32)
        self.high: NDArray[np.float32] = np.array(high, np.float32)

    def update(self, observation: Observation) -> NDArray[np.float32]:
        """Return the numbers of all parts, clipped to their bounds. The advance counts from the first call on."""
        assert observation.sensor_samples is not None, "a controller with an Observer declares uses_sensors = True"
        progress = self._progress
        if progress is None:
            progress = GoalProgress(self._robot, observation.sensor_samples.task)
            self._progress = progress
        progress.update(observation.joints, _newest_pose(observation))
        values: list[float] = []
        for part in self._parts.values():
            values.extend(part.read(observation, progress))
        numbers = np.array(values, dtype=np.float32)
        return np.minimum(np.maximum(numbers, self.low), self.high)

    @property
    def progress(self) -> GoalProgress:
        """The advance towards the goal as of the newest observation."""
        assert self._progress is not None, "there has been no observation yet"
        return self._progress


def _read_bearing(_observation: Observation, progress: GoalProgress) -> Sequence[float]:
    return math.cos(progress.bearing_rad), math.sin(progress.bearing_rad)


def _read_forces(observation: Observation, link_count: int) -> Sequence[float]:
    sample = _newest_sample(observation, keys.CONTACTS)
    return sum_contact_forces_n(sample if isinstance(sample, Contacts) else None, link_count)


def sum_contact_forces_n(sample: Contacts | None, link_count: int) -> list[float]:
    """Return the sum of the sizes of all contact forces on every link, (link_count,) in N.

    Args:
        sample: the newest contacts; None: there are none yet.
        link_count: number of links.
    """
    forces_n = [0.0] * link_count
    if sample is None:
        return forces_n
    for contact in sample.contacts:
        if contact.link < link_count:
            forces_n[contact.link] += math.hypot(*contact.force_l)
    return forces_n


def _read_velocity(observation: Observation, _progress: GoalProgress) -> Sequence[float]:
    pose = _newest_pose(observation)
    if pose is None:
        return 0.0, 0.0, 0.0
    return pose.velocity_w


def _read_angular_velocity(observation: Observation, _progress: GoalProgress) -> Sequence[float]:
    pose = _newest_pose(observation)
    if pose is None:
        return 0.0, 0.0, 0.0
    return pose.angular_velocity_w


def _newest_pose(observation: Observation) -> Pose | None:
    sample = _newest_sample(observation, keys.POSE)
    if isinstance(sample, Pose):
        return sample
    return None


def _newest_sample(observation: Observation, key: str) -> Message | None:
    if observation.sensor_samples is None:
        return None
    return observation.sensor_samples.newest.get(key)

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
from snakesim_hal.wire.messages import Contacts, Message, Pose, RobotDescription

# Bounds of an observation. They are generous: a value outside is clipped.
MAX_ANGLE_RAD = 2 * math.pi
MAX_FORCE_N = 1000.0
MAX_DISTANCE_M = 1000.0
MAX_SPEED_M_S = 10.0
MAX_ANGULAR_VELOCITY_RAD_S = 100.0
MAX_TIME_S = 1e5

# Ratios of these bounds to the limits of the motors.
MAX_SPEED_RATIO = 3.0  # loads turn joints faster than motors do
MAX_TORQUE_RATIO = 1.5  # torque sensors have noise

ReadValues = Callable[[Observation, GoalProgress], Sequence[float]]


@dataclass(frozen=True)
class ObservationPart:
    """A group of numbers in an observation, such as the angles of all joints."""

    names: Sequence[str]
    unit: str
    low: Sequence[float]
    high: Sequence[float]
    read: ReadValues
    sensor: str | None = None  # key of the sensor that it needs besides the joints


def _make_symmetric_part(
    names: Sequence[str],
    unit: str,
    maximum: float | Sequence[float],
    read: ReadValues,
    sensor: str | None = None,
) -> ObservationPart:
    """Make a part of the observation whose values are bounded symmetrically, by -maximum and maximum.

    Args:
        names: Names of the values.
        unit: Unit of the values.
        maximum: One bound for all values, or one for each.
        read: Reads the values from an observation and the progress towards the goal.
        sensor: Key of the sensor that the part needs besides the joints; None if it needs none.
    """
    high = [maximum] * len(names) if isinstance(maximum, int | float) else list(maximum)
    low = [-value for value in high]
    return ObservationPart(names, unit, low, high, read, sensor)


def make_observation_parts(robot: RobotDescription) -> dict[str, ObservationPart]:
    """Return all parts of an observation that a robot with every sensor can have, by name."""
    return (
        _make_joint_parts(robot)
        | _make_goal_parts()
        | _make_contact_parts(robot)
        | _make_pose_parts()
    )


def _make_joint_parts(robot: RobotDescription) -> dict[str, ObservationPart]:
    """Make the parts for the time since arming and for the measurements of the joints."""
    joints = robot.joints
    names = [joint.name for joint in joints]
    angles_rad = [max(MAX_ANGLE_RAD, -joint.angle_min_rad, joint.angle_max_rad) for joint in joints]
    speeds_rad_s = [MAX_SPEED_RATIO * joint.speed_limit_rad_s for joint in joints]
    torques_nm = [MAX_TORQUE_RATIO * joint.torque_limit_nm for joint in joints]
    return {
        "time_s": ObservationPart(
            ["since_arming"], "s", [0.0], [MAX_TIME_S], lambda observation, _: [observation.time_s]
        ),
        "angle_rad": _make_symmetric_part(
            names, "rad", angles_rad, lambda observation, _: observation.joints.angle_rad
        ),
        "velocity_rad_s": _make_symmetric_part(
            names, "rad/s", speeds_rad_s, lambda observation, _: observation.joints.velocity_rad_s
        ),
        "torque_nm": _make_symmetric_part(
            names, "N·m", torques_nm, lambda observation, _: observation.joints.torque_nm
        ),
    }


def _make_goal_parts() -> dict[str, ObservationPart]:
    """Make the parts for the bearing of the goal relative to the body's heading, and for the remaining distance."""
    return {
        "goal_bearing": _make_symmetric_part(
            ["cos", "sin"], "1", 1.0, _read_goal_bearing, keys.POSE
        ),
        "goal_m": ObservationPart(
            ["left"],
            "m",
            [0.0],
            [MAX_DISTANCE_M],
            lambda _, progress: [progress.remaining_distance_m],
            keys.POSE,
        ),
    }


def _make_contact_parts(robot: RobotDescription) -> dict[str, ObservationPart]:
    """Make the part for the magnitude of the contact force on every link."""
    names = [link.name for link in robot.links]
    link_count = len(names)
    low = [0.0] * link_count
    high = [MAX_FORCE_N] * link_count
    return {
        "contact_n": ObservationPart(
            names,
            "N",
            low,
            high,
            lambda observation, _: _read_contact_forces(observation, link_count),
            keys.CONTACTS,
        )
    }


def _make_pose_parts() -> dict[str, ObservationPart]:
    """Make the parts for the measurements of the pose sensor, in the world frame."""
    axes = ["x", "y", "z"]
    return {
        "position_w_m": _make_symmetric_part(
            axes, "m", MAX_DISTANCE_M, lambda _, progress: progress.pose[0], keys.POSE
        ),
        "orientation_wxyz": _make_symmetric_part(
            ["w", "x", "y", "z"], "1", 1.0, lambda _, progress: progress.pose[1], keys.POSE
        ),
        "velocity_w_m_s": _make_symmetric_part(
            axes, "m/s", MAX_SPEED_M_S, _read_velocity, keys.POSE
        ),
        "angular_velocity_w_rad_s": _make_symmetric_part(
            axes, "rad/s", MAX_ANGULAR_VELOCITY_RAD_S, _read_angular_velocity, keys.POSE
        ),
    }


DEFAULT_PARTS = ("angle_rad", "velocity_rad_s", "torque_nm", "goal_bearing", "goal_m", "contact_n")


def select_observation_parts(
    robot: RobotDescription, observe: Sequence[str] | None
) -> dict[str, ObservationPart]:
    """Return the parts that make up the observation of a policy, by their names.

    Args:
        robot: The robot that observes.
        observe: Names of the parts, in their order. None selects those in DEFAULT_PARTS that the robot has sensors for.

    Returns:
        The parts by name, in the order of `observe`.

    Raises:
        ConfigError: There is no part with one of the names, or the robot does not have the sensor of a part.
    """
    parts = make_observation_parts(robot)
    sensors = {sensor.key for sensor in robot.sensors}
    observable = {
        name: part for name, part in parts.items() if part.sensor is None or part.sensor in sensors
    }
    if observe is None:
        return {name: observable[name] for name in DEFAULT_PARTS if name in observable}
    if isinstance(observe, str) or not observe:
        raise ConfigError(
            f"observe={observe!r:.60}: give a sequence of names, such as ('angle_rad', 'contact_n')",
            code="policy/invalid",
        )
    for name in observe:
        if name not in parts:
            hint = suggest_word(str(name), parts)
            raise ConfigError(
                f"observe: no part {name!r:.60}; {hint}there are {', '.join(parts)}",
                code="policy/invalid",
            )
        if name not in observable:
            raise ConfigError(
                f"observe: {name!r} needs {parts[name].sensor}, which robot {robot.robot!r} has not",
                code="policy/invalid",
            )
    return {name: parts[name] for name in observe}


class ObservationBuilder:
    """Makes the observation of an episode, tick by tick."""

    def __init__(self, robot: RobotDescription, parts: Mapping[str, ObservationPart]) -> None:
        """Prepare to build the observations of one episode.

        Args:
            robot: The robot that observes.
            parts: The parts of the observation, as `select_observation_parts` returns them.
        """
        self._robot = robot
        self._parts = parts
        self._progress: GoalProgress | None = None  # None if there has been no observation yet

        # Sensors that the parts need, by key, and the bounds of the observation.
        self.sensors = {part.sensor for part in parts.values() if part.sensor is not None}
        low = [value for part in parts.values() for value in part.low]
        high = [value for part in parts.values() for value in part.high]
        self.low: NDArray[np.float32] = np.array(low, np.float32)
        self.high: NDArray[np.float32] = np.array(high, np.float32)

    def build_observation(self, observation: Observation) -> NDArray[np.float32]:
        """Return the values of all parts as one vector, clipped to their bounds.

        The progress towards the goal is measured from the first call on.
        """
        assert observation.sensor_samples is not None, (
            "a controller with an Observer declares uses_sensors = True"
        )
        progress = self._progress
        if progress is None:
            progress = GoalProgress(self._robot, observation.sensor_samples.task)
            self._progress = progress
        progress.update(observation.joints, _get_newest_pose(observation))
        values: list[float] = []
        for part in self._parts.values():
            values.extend(part.read(observation, progress))
        all_values = np.array(values, dtype=np.float32)
        return np.minimum(np.maximum(all_values, self.low), self.high)

    @property
    def progress(self) -> GoalProgress:
        """The advance towards the goal as of the newest observation."""
        assert self._progress is not None, "there has been no observation yet"
        return self._progress


def _read_goal_bearing(_observation: Observation, progress: GoalProgress) -> Sequence[float]:
    return math.cos(progress.goal_bearing_rad), math.sin(progress.goal_bearing_rad)


def _read_contact_forces(observation: Observation, link_count: int) -> Sequence[float]:
    sample = _get_newest_sample(observation, keys.CONTACTS)
    return sum_contact_forces_n(sample if isinstance(sample, Contacts) else None, link_count)


def sum_contact_forces_n(sample: Contacts | None, link_count: int) -> list[float]:
    """Sum the magnitudes of all contact forces on every link.

    Args:
        sample: The newest contacts; None if there are none yet.
        link_count: Number of links.

    Returns:
        (link_count,) sums in N.
    """
    forces_n = [0.0] * link_count
    if sample is None:
        return forces_n
    for contact in sample.contacts:
        if contact.link < link_count:
            forces_n[contact.link] += math.hypot(*contact.force_l)
    return forces_n


def _read_velocity(observation: Observation, _progress: GoalProgress) -> Sequence[float]:
    pose = _get_newest_pose(observation)
    if pose is None:
        return 0.0, 0.0, 0.0
    return pose.velocity_w


def _read_angular_velocity(observation: Observation, _progress: GoalProgress) -> Sequence[float]:
    pose = _get_newest_pose(observation)
    if pose is None:
        return 0.0, 0.0, 0.0
    return pose.angular_velocity_w


def _get_newest_pose(observation: Observation) -> Pose | None:
    sample = _get_newest_sample(observation, keys.POSE)
    if isinstance(sample, Pose):
        return sample
    return None


def _get_newest_sample(observation: Observation, key: str) -> Message | None:
    if observation.sensor_samples is None:
        return None
    return observation.sensor_samples.newest.get(key)

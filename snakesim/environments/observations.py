"""What an environment shows: parts of numbers, with names, units and bounds, as the robot's own sensors have them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim.environments.progress import Progress
from snakesim.environments.stepped import Robot
from snakesim_hal.errors import ConfigError, did_you_mean
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Description, Pose

MAX_ANGLE_RAD, MAX_FORCE_N, MAX_DISTANCE_M, MAX_SPEED_M_S, MAX_TURN_RAD_S = 2 * math.pi, 1000.0, 1000.0, 10.0, 100.0
SPEED_MARGIN, TORQUE_MARGIN = 3.0, 1.5  # over the limits of motors: loads turn joints faster, and gauges have noise

Read = Callable[[Robot, Progress], Sequence[float]]


@dataclass(frozen=True)
class Part:
    """Some numbers of an observation."""

    names: Sequence[str]
    unit: str
    low: Sequence[float]
    high: Sequence[float]
    read: Read
    sensor: str | None = None  # key of the sensor that it needs, besides the joints


def _symmetric(
    names: Sequence[str], unit: str, most: float | Sequence[float], read: Read, sensor: str | None = None
) -> Part:
    high = [most] * len(names) if isinstance(most, int | float) else list(most)
    return Part(names, unit, [-value for value in high], high, read, sensor)


def parts_of(robot: Description) -> dict[str, Part]:
    """Everything that there is to see of a robot with all sensors."""
    joints, links = robot.joints, [link.name for link in robot.links]
    names = [joint.name for joint in joints]
    angles = [max(MAX_ANGLE_RAD, -joint.angle_min_rad, joint.angle_max_rad) for joint in joints]
    speeds = [SPEED_MARGIN * joint.speed_limit_rad_s for joint in joints]
    torques = [TORQUE_MARGIN * joint.torque_limit_nm for joint in joints]
    count = len(links)
    return {
        "angle_rad": _symmetric(names, "rad", angles, lambda robot, _: robot.joints.angle_rad),
        "velocity_rad_s": _symmetric(names, "rad/s", speeds, lambda robot, _: robot.joints.velocity_rad_s),
        "torque_nm": _symmetric(names, "N·m", torques, lambda robot, _: robot.joints.torque_nm),
        "goal_bearing": _symmetric(["cos", "sin"], "1", 1.0, _bearing, keys.POSE),
        "goal_m": Part(["left"], "m", [0.0], [MAX_DISTANCE_M], lambda _, progress: [progress.left_m], keys.POSE),
        "contact_n": Part(
            links, "N", [0.0] * count, [MAX_FORCE_N] * count, lambda robot, _: _forces(robot, count), keys.CONTACTS
        ),
        "position_w_m": _symmetric(
            ["x", "y", "z"], "m", MAX_DISTANCE_M, lambda _, progress: progress.pose[0], keys.POSE
        ),
        "orientation_wxyz": _symmetric(["w", "x", "y", "z"], "1", 1.0, lambda _, progress: progress.pose[1], keys.POSE),
        "velocity_w_m_s": _symmetric(["x", "y", "z"], "m/s", MAX_SPEED_M_S, _velocity, keys.POSE),
        "angular_velocity_w_rad_s": _symmetric(["x", "y", "z"], "rad/s", MAX_TURN_RAD_S, _turning, keys.POSE),
    }


DEFAULT = ("angle_rad", "velocity_rad_s", "torque_nm", "goal_bearing", "goal_m", "contact_n")


def chosen(robot: Description, observe: Sequence[str] | None) -> dict[str, Part]:
    """The parts of these names; None: those of DEFAULT that the robot has sensors for. Raises ConfigError."""
    parts, sensors = parts_of(robot), {sensor.key for sensor in robot.sensors}
    has = {name: part for name, part in parts.items() if part.sensor is None or part.sensor in sensors}
    if observe is None:
        return {name: has[name] for name in DEFAULT if name in has}
    if isinstance(observe, str) or not observe:
        raise ConfigError(f"observe={observe!r:.60}: give a sequence of names, such as ('angle_rad', 'contact_n')")
    for name in observe:
        if name not in parts:
            hint = did_you_mean(str(name), parts)
            raise ConfigError(f"observe: no part {name!r:.60}; {hint}there are {', '.join(parts)}")
        if name not in has:
            raise ConfigError(f"observe: {name!r} needs {parts[name].sensor}, which robot {robot.robot!r} has not")
    return {name: parts[name] for name in observe}


def _bearing(_robot: Robot, progress: Progress) -> Sequence[float]:
    return math.cos(progress.bearing_rad), math.sin(progress.bearing_rad)


def _forces(robot: Robot, links: int) -> Sequence[float]:
    """On every link, summed over its contacts."""
    forces = [0.0] * links
    contacts = robot.newest.get(keys.CONTACTS)
    if isinstance(contacts, Contacts):
        for contact in contacts.contacts:
            forces[contact.link] += math.hypot(*contact.force_l)
    return forces


def _velocity(robot: Robot, _progress: Progress) -> Sequence[float]:
    pose = robot.newest.get(keys.POSE)
    return pose.velocity_w if isinstance(pose, Pose) else (0.0, 0.0, 0.0)


def _turning(robot: Robot, _progress: Progress) -> Sequence[float]:
    pose = robot.newest.get(keys.POSE)
    return pose.angular_velocity_w if isinstance(pose, Pose) else (0.0, 0.0, 0.0)

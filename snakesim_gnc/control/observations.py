"""What a learned policy sees: parts of numbers, with names, units and bounds, as the robot's own sensors have them.

Environments and the controller `policy` both read them here, so that a policy sees what it has seen in training.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.goal_progress import Progress
from snakesim_hal.base.errors import ConfigError, did_you_mean
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Description, Message, Pose

MAX_ANGLE_RAD, MAX_FORCE_N, MAX_DISTANCE_M, MAX_SPEED_M_S, MAX_TURN_RAD_S = 2 * math.pi, 1000.0, 1000.0, 10.0, 100.0
MAX_TIME_S = 1e5
SPEED_MARGIN, TORQUE_MARGIN = 3.0, 1.5  # over the limits of motors: loads turn joints faster, and gauges have noise

Read = Callable[[View, Progress], Sequence[float]]


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
        "time_s": Part(["since_arming"], "s", [0.0], [MAX_TIME_S], lambda view, _: [view.time_s]),
        "angle_rad": _symmetric(names, "rad", angles, lambda view, _: view.joints.angle_rad),
        "velocity_rad_s": _symmetric(names, "rad/s", speeds, lambda view, _: view.joints.velocity_rad_s),
        "torque_nm": _symmetric(names, "N·m", torques, lambda view, _: view.joints.torque_nm),
        "goal_bearing": _symmetric(["cos", "sin"], "1", 1.0, _bearing, keys.POSE),
        "goal_m": Part(["left"], "m", [0.0], [MAX_DISTANCE_M], lambda _, progress: [progress.left_m], keys.POSE),
        "contact_n": Part(
            links, "N", [0.0] * count, [MAX_FORCE_N] * count, lambda view, _: _forces(view, count), keys.CONTACTS
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


class Observer:
    """Reads some parts, one after the other."""

    def __init__(self, robot: Description, parts: Mapping[str, Part]) -> None:
        """parts: as `chosen` returns them."""
        self._robot, self._parts = robot, parts
        self.sensors = {part.sensor for part in parts.values() if part.sensor is not None}
        self.low: NDArray[np.float32] = np.array([low for part in parts.values() for low in part.low], np.float32)
        self.high: NDArray[np.float32] = np.array([high for part in parts.values() for high in part.high], np.float32)
        self._progress: Progress | None = None

    def update(self, view: View) -> NDArray[np.float32]:
        """The numbers of all parts, within their bounds. The first view is where the way to the goal begins."""
        assert view.senses is not None, "a controller of observations has SENSES = True"
        if self._progress is None:
            self._progress = Progress(self._robot, view.senses.task)
        pose = _newest(view, keys.POSE)
        self._progress.update(view.joints, pose if isinstance(pose, Pose) else None)
        values = [value for part in self._parts.values() for value in part.read(view, self._progress)]
        return np.minimum(np.maximum(np.array(values, dtype=np.float32), self.low), self.high)

    @property
    def progress(self) -> Progress:
        """As of the newest view."""
        assert self._progress is not None, "there has been no view yet"
        return self._progress


def _bearing(_view: View, progress: Progress) -> Sequence[float]:
    return math.cos(progress.bearing_rad), math.sin(progress.bearing_rad)


def _forces(view: View, links: int) -> Sequence[float]:
    """On every link, summed over its contacts."""
    forces = [0.0] * links
    contacts = _newest(view, keys.CONTACTS)
    if isinstance(contacts, Contacts):
        for contact in contacts.contacts:
            if contact.link < links:
                forces[contact.link] += math.hypot(*contact.force_l)
    return forces


def _velocity(view: View, _progress: Progress) -> Sequence[float]:
    pose = _newest(view, keys.POSE)
    return pose.velocity_w if isinstance(pose, Pose) else (0.0, 0.0, 0.0)


def _turning(view: View, _progress: Progress) -> Sequence[float]:
    pose = _newest(view, keys.POSE)
    return pose.angular_velocity_w if isinstance(pose, Pose) else (0.0, 0.0, 0.0)


def _newest(view: View, key: str) -> Message | None:
    return None if view.senses is None else view.senses.newest.get(key)

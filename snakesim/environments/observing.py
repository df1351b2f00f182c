"""What the agents of many environments observe, and how far their robots have advanced, as rows of arrays.

The parts of an observation are those of `snakesim_gnc.control.observations`, which policies read on a robot.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim.environments.armed import Mask
from snakesim.environments.robots import Robots
from snakesim_gnc.control.goal_progress import BodyLocator, GoalProgress
from snakesim_gnc.control.observations import ObservationPart
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Task
from snakesim_hal.wire.messages import Description


@dataclass(frozen=True)
class Seen:
    """What there is to observe of all robots at one tick."""

    time_s: Floats  # (robots,), since arming
    joints: Floats  # (robots, 3 * joints)
    poses: Floats  # (robots, 7)
    progress: Sequence[GoalProgress]
    robots: Robots  # measures what few environments observe


class Observers:
    """The observers of all environments.

    Attributes:
        progress: the advance of each robot towards its goal.
    """

    def __init__(self, robots: int, description: Description, parts: Mapping[str, ObservationPart]) -> None:
        """Make room for robots.

        Args:
            robots: their number.
            description: a robot like them.
            parts: the parts of an observation, in their order.
        """
        self._readers = [READERS[name] for name in parts]
        self._low = np.array([value for part in parts.values() for value in part.low], np.float32)
        self._high = np.array([value for part in parts.values() for value in part.high], np.float32)
        self._descriptions = [description] * robots
        self._has_equal_links = True
        self._locator = BodyLocator(description)
        self._start_poses = np.zeros((robots, 7))
        self._start_poses[:, 3] = 1.0
        no_task = Task((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), None)
        self.progress = [GoalProgress(description, no_task) for _ in range(robots)]

    def restart(self, robot: int, description: Description, task: Task) -> None:
        """Start an episode. The advance counts from the first observation on."""
        self._descriptions[robot] = description
        first = self._descriptions[0]
        self._has_equal_links = all(_has_equal_links(first, other) for other in self._descriptions)
        self._locator = BodyLocator(first)
        self._start_poses[robot] = [*task.start_position_w, *task.start_wxyz]
        self.progress[robot] = GoalProgress(description, task)

    def observe(self, robots: Robots, time_s: Floats, rows: Mask) -> NDArray[np.float32]:
        """Measure the advance of some robots, and return the observations of all, (robots, n).

        Args:
            robots: the robots.
            time_s: (robots,), time since arming.
            rows: (robots,), the robots whose advance is measured; the observations of the others mean nothing.
        """
        has_pose, poses = robots.read_poses()
        if not has_pose.all():
            poses = np.where(has_pose[:, None], poses, self._start_poses)
        self._measure_advance(robots.joints, poses, rows)
        seen = Seen(time_s, robots.joints, poses, self.progress, robots)
        columns = [read(seen) for read in self._readers]
        numbers = np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")
        return np.minimum(np.maximum(numbers, self._low), self._high)

    def _measure_advance(self, joints: Floats, poses: Floats, rows: Mask) -> None:
        angles_rad = joints[:, : joints.shape[1] // 3]
        pose_numbers = poses.tolist()
        indices = np.flatnonzero(rows).tolist()
        groups = [[robot] for robot in indices]
        if self._has_equal_links and indices:
            groups = [indices]  # faster
        for group in groups:
            locator = self._locator if self._has_equal_links else BodyLocator(self._descriptions[group[0]])
            nodes_w, centers_w = locator.locate(poses[group], angles_rad[group])
            for i, robot in enumerate(group):
                progress = self.progress[robot]
                progress.pose = pose_numbers[robot][:3], pose_numbers[robot][3:]
                progress.follow(nodes_w[i], centers_w[i])


def _has_equal_links(first: Description, second: Description) -> bool:
    """Return whether two robots have the same links and axes, so that their bodies are located together."""
    if first is second:
        return True
    return first.links == second.links and [j.axis for j in first.joints] == [j.axis for j in second.joints]


def _read_joints(which: int) -> Callable[[Seen], Floats]:
    """Return a function that reads angles (0), velocities (1) or torques (2)."""

    def read(seen: Seen) -> Floats:
        count = seen.joints.shape[1] // 3
        return seen.joints[:, which * count : (which + 1) * count]

    return read


def _read_bearings(seen: Seen) -> Floats:
    return np.array([(math.cos(p.bearing_rad), math.sin(p.bearing_rad)) for p in seen.progress])


def _read_distances_left(seen: Seen) -> Floats:
    return np.array([[progress.left_m] for progress in seen.progress])


READERS: Mapping[str, Callable[[Seen], Floats]] = {
    "time_s": lambda seen: seen.time_s[:, None],
    "angle_rad": _read_joints(0),
    "velocity_rad_s": _read_joints(1),
    "torque_nm": _read_joints(2),
    "goal_bearing": _read_bearings,
    "goal_m": _read_distances_left,
    "contact_n": lambda seen: seen.robots.read_contact_forces(),
    "position_w_m": lambda seen: seen.poses[:, :3],
    "orientation_wxyz": lambda seen: seen.poses[:, 3:],
    "velocity_w_m_s": lambda seen: seen.robots.read_velocities()[:, :3],
    "angular_velocity_w_rad_s": lambda seen: seen.robots.read_velocities()[:, 3:],
}

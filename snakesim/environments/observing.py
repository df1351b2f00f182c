"""What the agents of many environments observe, and how far their robots have advanced, as rows of arrays.

The parts of an observation are those of `snakesim_gnc.control.observations`, which policies read on a robot.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim.environments.armed import Mask
from snakesim.environments.robots import EnvironmentRobots
from snakesim_gnc.control.goal_progress import BodyLocator, GoalProgress
from snakesim_gnc.control.observations import ObservationPart
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Task
from snakesim_hal.wire.messages import RobotDescription


@dataclass(frozen=True)
class BatchState:
    """The state of all robots at one tick, from which the parts of observations are read."""

    time_s: Floats  # (robots,), since arming
    joints: Floats  # (robots, 3 * joints): angles, velocities, torques
    poses: Floats  # (robots, 7): positions, quaternions wxyz
    progress: Sequence[GoalProgress]
    robots: EnvironmentRobots  # read only by the parts that few environments observe


class BatchObserver:
    """Computes the observations of all environments, and how far their robots have advanced.

    Attributes:
        progress: Advance of each robot towards its goal.
    """

    def __init__(
        self, robot_count: int, description: RobotDescription, parts: Mapping[str, ObservationPart]
    ) -> None:
        """Allocate the arrays for a number of robots, without tasks. `restart` sets the task of each robot.

        Args:
            robot_count: Number of robots.
            description: Description of a robot with the same joints, which stands for each robot until its `restart`.
            parts: Parts of an observation by name, in their order in the observation.
        """
        self._part_readers = [PART_READERS[name] for name in parts]
        self._low = np.array([value for part in parts.values() for value in part.low], np.float32)
        self._high = np.array([value for part in parts.values() for value in part.high], np.float32)
        self._descriptions = [description] * robot_count
        self._has_equal_links = True
        self._locator = BodyLocator(description)
        self._start_poses = np.zeros((robot_count, 7))
        self._start_poses[:, 3] = 1.0
        no_task = Task((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), None)
        self.progress = [GoalProgress(description, no_task) for _ in range(robot_count)]

    def restart(self, robot_index: int, description: RobotDescription, task: Task) -> None:
        """Start an episode of a robot with a new task. The advance counts from the first observation on."""
        self._descriptions[robot_index] = description
        first_description = self._descriptions[0]
        self._has_equal_links = all(
            _has_equal_links(first_description, other) for other in self._descriptions
        )
        self._locator = BodyLocator(first_description)
        self._start_poses[robot_index] = [*task.start_position_w, *task.start_wxyz]
        self.progress[robot_index] = GoalProgress(description, task)

    def observe(self, robots: EnvironmentRobots, time_s: Floats, rows: Mask) -> NDArray[np.float32]:
        """Measure the advance of some robots, and return the observations of all robots, (robots, n).

        Args:
            robots: Robots of all environments.
            time_s: Time since arming, (robots,).
            rows: Which robots' advance is measured, (robots,). The observations of other robots are not valid.
        """
        has_pose, poses = robots.read_poses()
        if np.count_nonzero(has_pose) < len(has_pose):  # faster than `all`
            poses = np.where(has_pose[:, None], poses, self._start_poses)
        self._measure_advance(robots.joints, poses, rows)
        state = BatchState(time_s, robots.joints, poses, self.progress, robots)
        columns = [read(state) for read in self._part_readers]
        values = np.concatenate(columns, axis=1, dtype=np.float32, casting="same_kind")
        return np.minimum(np.maximum(values, self._low), self._high)

    def _measure_advance(self, joints: Floats, poses: Floats, rows: Mask) -> None:
        """Update the progress of some robots. Robots with equal links are located together, which is faster."""
        angles_rad = joints[:, : joints.shape[1] // 3]
        pose_lists = poses.tolist()
        indices = np.flatnonzero(rows).tolist()
        groups = [[robot] for robot in indices]
        if self._has_equal_links and indices:
            groups = [indices]
        for group in groups:
            locator = (
                self._locator
                if self._has_equal_links
                else BodyLocator(self._descriptions[group[0]])
            )
            # To copy all rows would only take time.
            selected = slice(None) if len(group) == len(poses) else group
            nodes_w, centers_w = locator.compute_body_positions(
                poses[selected], angles_rad[selected]
            )
            for i, robot in enumerate(group):
                progress = self.progress[robot]
                progress.pose = pose_lists[robot][:3], pose_lists[robot][3:]
                progress.update_from_body(nodes_w[i], centers_w[i])


def _has_equal_links(first: RobotDescription, second: RobotDescription) -> bool:
    """Return whether two robots have the same links and axes, so that their bodies are located together."""
    if first is second:
        return True
    return first.links == second.links and [j.axis for j in first.joints] == [
        j.axis for j in second.joints
    ]


def _make_joint_reader(quantity_index: int) -> Callable[[BatchState], Floats]:
    """Return a function that reads the angles (index 0), velocities (1) or torques (2) of all joints."""

    def read(state: BatchState) -> Floats:
        count = state.joints.shape[1] // 3
        return state.joints[:, quantity_index * count : (quantity_index + 1) * count]

    return read


def _read_bearings(state: BatchState) -> Floats:
    return np.array(
        [(math.cos(p.goal_bearing_rad), math.sin(p.goal_bearing_rad)) for p in state.progress]
    )


def _read_distances_left(state: BatchState) -> Floats:
    return np.array([[progress.remaining_distance_m] for progress in state.progress])


PART_READERS: Mapping[str, Callable[[BatchState], Floats]] = {
    "time_s": lambda state: state.time_s[:, None],
    "angle_rad": _make_joint_reader(0),
    "velocity_rad_s": _make_joint_reader(1),
    "torque_nm": _make_joint_reader(2),
    "goal_bearing": _read_bearings,
    "goal_m": _read_distances_left,
    "contact_n": lambda state: state.robots.read_contact_forces(),
    "position_w_m": lambda state: state.poses[:, :3],
    "orientation_wxyz": lambda state: state.poses[:, 3:],
    "velocity_w_m_s": lambda state: state.robots.read_velocities()[:, :3],
    "angular_velocity_w_rad_s": lambda state: state.robots.read_velocities()[:, 3:],
}

"""Measures how far a run advanced towards its goal, the energy for that, and how long the body was stationary."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_body_points_w
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, WaypointGoal
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_operator.results.run_log import RunRecord

SAMPLE_PERIOD_S = 0.1
# A run continues that long at its goal: noise may move the body back over the line.
GOAL_HOLD_DURATION_S = 0.5
MIN_PROGRESS_M = 0.03  # a run that advances less than this within the stall timeout is stuck
MIN_DISTANCE_M = 0.1  # energy per meter is meaningless for a shorter distance


@dataclass(frozen=True)
class ForwardProgress:
    """Path of the center of mass and of the head, and the advance towards the goal of the mission."""

    goal: HeadingGoal | WaypointGoal | None
    time_s: Floats  # (m,) since the first row; about one sample every SAMPLE_PERIOD_S
    center_w: Floats  # (m, 2) center of mass in the world, in m
    head_w: Floats  # (m, 2) front end of the head in the world, in m

    @staticmethod
    def from_run(record: RunRecord) -> "ForwardProgress | None":
        """Compute the advance of a run from poses that are sampled every SAMPLE_PERIOD_S.

        The first and the last row of each part without a gap are sampled too, so that nothing is interpolated over a
        gap that begins or ends between two samples.

        Args:
            record: The recorded run.

        Returns:
            The advance, or None if fewer than two poses are known.
        """
        rows_with_pose = np.flatnonzero(record.has_pose)
        if len(rows_with_pose) < 2:
            return None
        row_step = max(round(SAMPLE_PERIOD_S * record.config.rate_hz), 1)
        chosen_rows: set[int] = {int(rows_with_pose[-1]), *rows_with_pose[::row_step].tolist()}
        for rows_without_gap in record.contiguous_rows:
            for row in (rows_without_gap[0], rows_without_gap[-1]):
                if record.has_pose[row]:
                    chosen_rows.add(int(row))
        rows = sorted(chosen_rows)
        body_points_w = np.array([record.find_body_points_w(row) for row in rows])
        time_s = record.time_s[rows] - record.time_s[0]
        return ForwardProgress.from_body_points(
            record.config.mission.goal, record.description, time_s, body_points_w
        )

    @staticmethod
    def from_body_points(
        goal: HeadingGoal | WaypointGoal | None,
        robot: RobotDescription,
        time_s: Floats,
        body_points_w: Floats,
    ) -> "ForwardProgress":
        """Compute the advance towards a goal from sampled positions of the body.

        Args:
            goal: Goal of the mission; None if it has none.
            robot: Description of the robot, with the masses of its links.
            time_s: (m,) times of the samples, in s.
            body_points_w: (m, joints + 2, 3) tail end, joints and head end in the world, in m.
        """
        center_w = compute_center_of_mass_w(robot, body_points_w)
        return ForwardProgress(goal, time_s, center_w, body_points_w[:, -1, :2])

    @property
    def goal_distance_m(self) -> float | None:
        """Distance from the start to the goal, in m; None if the mission has no goal."""
        match self.goal:
            case HeadingGoal(distance_m=distance):
                return distance
            case WaypointGoal(points_m=points):
                legs = np.diff(np.vstack([self.head_w[0], points]), axis=0)
                return float(np.hypot(*legs.T).sum())
            case None:
                return None

    @cached_property
    def max_advance_m(self) -> Floats:
        """Maximum advance towards the goal so far, (m,); without a goal, the advance along the body's first heading."""
        match self.goal:
            case HeadingGoal(heading_rad=heading):
                return self._project_max_advance_m(heading)
            case WaypointGoal() as goal:
                return np.maximum.accumulate(self._compute_waypoint_advance_m(goal))
            case None:
                return self.max_heading_advance_m

    @cached_property
    def max_heading_advance_m(self) -> Floats:
        """Maximum advance so far along the body's first heading, from its center of mass to its head, (m,)."""
        forward = self.head_w[0] - self.center_w[0]
        return self._project_max_advance_m(float(np.arctan2(forward[1], forward[0])))

    @cached_property
    def goal_reached_s(self) -> float | None:
        """Time at which the goal was reached, in s; None if it was not reached, or the mission has no goal."""
        goal_m = self.goal_distance_m
        if goal_m is None or self.max_advance_m[-1] < goal_m:
            return None
        first_beyond = int(np.argmax(self.max_advance_m >= goal_m))
        if first_beyond == 0:
            return 0.0
        # The samples before and after the goal was reached.
        pair = slice(first_beyond - 1, first_beyond + 1)
        return float(np.interp(goal_m, self.max_advance_m[pair], self.time_s[pair]))

    @property
    def goal_or_end_s(self) -> float:
        """Time at which the goal was reached, or the time of the last sample, in s."""
        if self.goal_reached_s is None:
            return float(self.time_s[-1])
        return self.goal_reached_s

    @property
    def final_advance_m(self) -> float:
        """Advance until the goal was reached, or until the last sample, in m."""
        if self.goal_reached_s is None:
            return float(self.max_advance_m[-1])
        return float(self.goal_distance_m or 0.0)

    @property
    def stationary_duration_s(self) -> float:
        """Duration in which the body was stationary, until the goal was reached or the last sample, in s."""
        window = max(round(WINDOW_S / SAMPLE_PERIOD_S), 1)  # number of samples
        if len(self.time_s) <= window:
            return 0.0
        # For each sample from the first complete window on: the distance moved in the window, and the time since the
        # sample before.
        moved_m = np.hypot(*(self.center_w[window:] - self.center_w[:-window]).T)
        durations_s = np.diff(self.time_s)[window - 1 :]
        is_stationary = (moved_m < MOVING_M) & (self.time_s[window:] <= self.goal_or_end_s)
        return float(durations_s[is_stationary].sum())

    def _project_max_advance_m(self, heading_rad: float) -> Floats:
        """Return the maximum advance so far of the center of mass along a heading, (m,)."""
        forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
        return np.maximum.accumulate((self.center_w - self.center_w[0]) @ forward)

    def _compute_waypoint_advance_m(self, goal: WaypointGoal) -> Floats:
        """Return the advance of the head along the waypoints, (m,): length of all legs minus the remaining distance."""
        points = np.array(goal.points_m)
        leg_lengths_m = np.hypot(*np.diff(points, axis=0).T)
        # Length of all legs after each point; 0 for the last point.
        remaining_after_point_m = np.append(np.cumsum(leg_lengths_m[::-1])[::-1], 0.0)
        total_m = self.goal_distance_m or 0.0
        next_point = 0  # index of the first point that the head has not reached yet
        advance_m: list[float] = []
        for head in self.head_w:
            while (
                next_point < len(points) and np.hypot(*(points[next_point] - head)) <= goal.within_m
            ):
                next_point += 1
            # Straight to the next point, and then along all legs after it; 0 after the last point.
            remaining_m = 0.0
            if next_point < len(points):
                remaining_m = (
                    np.hypot(*(points[next_point] - head)) + remaining_after_point_m[next_point]
                )
            advance_m.append(total_m - float(remaining_m))
        return np.array(advance_m)


class GoalMonitor:
    """Monitors a run, and detects its end: the goal was reached GOAL_HOLD_DURATION_S ago, or the robot is stuck."""

    def __init__(
        self, config: RunConfig, robot: RobotDescription, stall_timeout_s: float | None = None
    ) -> None:
        """Prepare to monitor a run.

        Args:
            config: Configuration of the run, with the goal of its mission.
            robot: Description of the robot.
            stall_timeout_s: Robot time without an advance after which the robot counts as stuck, in s; None for no
                timeout.
        """
        self._goal = config.mission.goal
        self._robot = robot
        self._stall_timeout_s = stall_timeout_s
        self.has_stalled = False
        self._time_s: list[float] = []
        self._body_points_w: list[Floats] = []

    def update_and_check_end(self, black_box: BlackBox) -> bool:
        """Read the newest row of the black box, and return whether the run is over.

        The run is over GOAL_HOLD_DURATION_S after the goal was reached, or if the robot is stuck.
        """
        if self._goal is None or not black_box.row_count:
            return False
        if not self._time_s:  # the advance counts from the first known pose
            self._add_first_known_pose(black_box, 0)
        if not self._add_first_known_pose(black_box, black_box.row_count - 1):
            return False
        now_s = self._time_s[-1]
        progress = ForwardProgress.from_body_points(
            self._goal, self._robot, np.array(self._time_s), np.array(self._body_points_w)
        )
        if progress.goal_reached_s is not None:
            return now_s > progress.goal_reached_s + GOAL_HOLD_DURATION_S
        # The first sample that is less than MIN_PROGRESS_M behind the newest one: no real advance since then.
        last_progress = int(
            np.argmax(progress.max_advance_m > progress.max_advance_m[-1] - MIN_PROGRESS_M)
        )
        self.has_stalled = (
            self._stall_timeout_s is not None
            and now_s - self._time_s[last_progress] >= self._stall_timeout_s
        )
        return self.has_stalled

    def _add_first_known_pose(self, black_box: BlackBox, first_row: int) -> bool:
        """Add the first sample at or after a row in which the pose is known. Returns False if there is none."""
        rows = black_box.layout.decode_rows(black_box.read_rows(first_row)[1])
        poses = zip(rows["position_w_m"], rows["orientation_wxyz"], rows["angle_rad"], strict=True)
        for i, pose in enumerate(poses):
            if all(np.isfinite(part).all() for part in pose):
                self._time_s.append(float(rows["time_s"][i]))
                self._body_points_w.append(compute_body_points_w(self._robot, *pose))
                return True
        return False


def compute_center_of_mass_w(robot: RobotDescription, body_points_w: Floats) -> Floats:
    """Compute the horizontal position of the center of mass.

    Args:
        robot: Description of the robot, with the masses of its links.
        body_points_w: (..., joints + 2, 3) tail end, joints and head end in the world, in m.

    Returns:
        (..., 2) the center of mass in the world, in m.
    """
    masses_kg = np.array([link.mass_kg for link in robot.links])[:, None]
    link_centers_w = 0.5 * (body_points_w[..., :-1, :2] + body_points_w[..., 1:, :2])
    return (link_centers_w * masses_kg).sum(axis=-2) / masses_kg.sum()


def compute_energy_j_per_m(record: RunRecord, progress: ForwardProgress) -> float | None:
    """Compute the energy per meter of advance until the goal or the end; None if the advance is too short."""
    if progress.final_advance_m < MIN_DISTANCE_M:
        return None
    is_before_goal = record.time_s - record.time_s[0] <= progress.goal_or_end_s
    return compute_energy_j(record, is_before_goal) / progress.final_advance_m


def compute_energy_j(record: RunRecord, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Integrate |torque x velocity| of all joints over the selected rows, in J.

    Each row stands for a control period. Unknown values count as 0.
    """
    return float(
        np.nansum(np.abs(_compute_joint_power_w(record)[rows])) * _get_control_period_s(record)
    )


def compute_work_j(record: RunRecord, mode: JointMode) -> float:
    """Compute the sum of torque x velocity of all joints while they are in a mode, in J.

    Each row stands for a control period. Torque is sampled at the end of a period. In position mode, its component
    along the motion is lowest there, because the target has not stepped since the start of the period. So the sum is
    less than the work of the motors, and may be negative although they drive the body. Unknown values count as 0.

    Args:
        record: The recorded run.
        mode: Mode of the joints whose rows are added.
    """
    return float(
        np.nansum(np.where(record.mode == mode, _compute_joint_power_w(record), 0.0))
        * _get_control_period_s(record)
    )


def _compute_joint_power_w(record: RunRecord) -> Floats:
    return record.torque_nm * record.velocity_rad_s


def _get_control_period_s(record: RunRecord) -> float:
    return record.config.period_ns * 1e-9

"""How far a run advanced towards its mission's goal, what that cost, and for how long the body was stationary."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import find_nodes_w
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, WaypointGoal
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.wire.messages import Description, Mode
from snakesim_operator.results.run_log import RunRecord

SAMPLE_S = 0.1
LASTING_S = 0.5  # for which a run continues at its goal, because noise may move the body back over the line
GIVE_UP_M = 0.03  # a run that advances less within its time limit is stuck
MIN_DISTANCE_M = 0.1  # energy per meter means nothing over less


@dataclass(frozen=True)
class Advance:
    """Samples of the body's place, ten a second or fewer."""

    goal: HeadingGoal | WaypointGoal | None
    time_s: Floats  # (m,) since the first row
    center_w: Floats  # (m, 2) center of mass
    head_w: Floats  # (m, 2)

    @staticmethod
    def from_run(record: RunRecord) -> "Advance | None":
        """Compute how a run advanced, from poses sampled every SAMPLE_S.

        Both ends of each stretch without a gap are sampled too, so that nothing is interpolated over a gap that begins
        or ends between two samples.

        Args:
            record: The recorded run.

        Returns:
            The advance; None if fewer than two poses are known.
        """
        posed_rows = np.flatnonzero(record.posed)
        if len(posed_rows) < 2:
            return None
        row_step = max(round(SAMPLE_S * record.config.rate_hz), 1)
        stretch_ends: list[int] = []
        for stretch in record.stretches:
            for row in (stretch[0], stretch[-1]):
                if record.posed[row]:
                    stretch_ends.append(row)
        periodic_rows = posed_rows[::row_step]
        last_row = posed_rows[-1:]
        end_rows = np.array(stretch_ends, dtype=np.int64)
        rows = np.unique(np.concatenate([periodic_rows, last_row, end_rows]))
        nodes = np.array([record.nodes_w(int(row)) for row in rows])
        time_s = record.time_s[rows] - record.time_s[0]
        return Advance.along(record.config.mission.goal, record.description, time_s, nodes)

    @staticmethod
    def along(goal: HeadingGoal | WaypointGoal | None, robot: Description, time_s: Floats, nodes: Floats) -> "Advance":
        """Return the advance towards a goal.

        Args:
            goal: The goal; None: the mission has none.
            robot: The robot.
            time_s: (m,) times of the samples.
            nodes: (m, joints + 2, 3) tail end, joints and head end in the world, as of `nodes_w`.
        """
        return Advance(goal, time_s, body_center_w(robot, nodes), nodes[:, -1, :2])

    @property
    def goal_m(self) -> float | None:
        """The distance from the start to the goal; None without a goal."""
        match self.goal:
            case HeadingGoal(distance_m=distance):
                return distance
            case WaypointGoal(points_m=points):
                legs = np.diff(np.vstack([self.head_w[0], points]), axis=0)
                return float(np.hypot(*legs.T).sum())
            case None:
                return None

    @cached_property
    def along_m(self) -> Floats:
        """The maximum advance towards the goal so far, (m,); without a goal the one along the body's first heading."""
        match self.goal:
            case HeadingGoal(heading_rad=heading):
                return self._projected(heading)
            case WaypointGoal() as goal:
                return np.maximum.accumulate(self._past_points(goal))
            case None:
                return self.along_heading_m

    @cached_property
    def along_heading_m(self) -> Floats:
        """The maximum advance so far along the body's first heading, from its center to its head, (m,)."""
        forward = self.head_w[0] - self.center_w[0]
        return self._projected(float(np.arctan2(forward[1], forward[0])))

    @cached_property
    def crossed_s(self) -> float | None:
        """The time at which the goal was reached; None if it was not, or there is none."""
        goal_m = self.goal_m
        if goal_m is None or self.along_m[-1] < goal_m:
            return None
        after = int(np.argmax(self.along_m >= goal_m))
        if after == 0:
            return 0.0
        pair = slice(after - 1, after + 1)
        return float(np.interp(goal_m, self.along_m[pair], self.time_s[pair]))

    @property
    def until_s(self) -> float:
        """The time at which the goal was reached, or the end."""
        if self.crossed_s is None:
            return float(self.time_s[-1])
        return self.crossed_s

    @property
    def reached_m(self) -> float:
        """The advance until the goal was reached, or the end."""
        if self.crossed_s is None:
            return float(self.along_m[-1])
        return float(self.goal_m or 0.0)

    @property
    def stalled_s(self) -> float:
        """The time in which the body was stationary, until the goal was reached or the end."""
        window = max(round(WINDOW_S / SAMPLE_S), 1)
        if len(self.time_s) <= window:
            return 0.0
        moved_m = np.hypot(*(self.center_w[window:] - self.center_w[:-window]).T)
        durations_s = np.diff(self.time_s)[window - 1 :]
        stands = (moved_m < MOVING_M) & (self.time_s[window:] <= self.until_s)
        return float(durations_s[stands].sum())

    def _projected(self, heading_rad: float) -> Floats:
        """Return the maximum advance so far of the center of mass along a heading, (m,)."""
        forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
        return np.maximum.accumulate((self.center_w - self.center_w[0]) @ forward)

    def _past_points(self, goal: WaypointGoal) -> Floats:
        """Return the advance of the head along the waypoints, (m,): the length of all legs minus what is left."""
        points = np.array(goal.points_m)
        leg_lengths_m = np.hypot(*np.diff(points, axis=0).T)
        left_after_point_m = np.append(np.cumsum(leg_lengths_m[::-1])[::-1], 0.0)
        total_m = self.goal_m or 0.0
        next_point = 0
        advance_m: list[float] = []
        for head in self.head_w:
            while next_point < len(points) and np.hypot(*(points[next_point] - head)) <= goal.within_m:
                next_point += 1
            left_m = 0.0
            if next_point < len(points):
                left_m = np.hypot(*(points[next_point] - head)) + left_after_point_m[next_point]
            advance_m.append(total_m - float(left_m))
        return np.array(advance_m)


class GoalWatch:
    """Watches a run, and reports when it may end: its goal was reached a while ago, or it is stuck."""

    def __init__(self, config: RunConfig, robot: Description, give_up_s: float | None = None) -> None:
        """Watch a run.

        Args:
            config: Its configuration, with the goal.
            robot: The robot.
            give_up_s: Robot time without an advance after which the run is stuck; None: it never is.
        """
        self._goal = config.mission.goal
        self._robot = robot
        self._give_up_s = give_up_s
        self.gave_up = False
        self._time_s: list[float] = []
        self._nodes: list[Floats] = []

    def over(self, black_box: BlackBox) -> bool:
        """Read the newest row, and return whether the run is over: LASTING_S after the goal, or when it is stuck."""
        if self._goal is None or not black_box.ticks:
            return False
        if not self._time_s:  # advance counts from the first pose
            self._add_sample(black_box, 0)
        if not self._add_sample(black_box, black_box.ticks - 1):
            return False
        now_s = self._time_s[-1]
        advance = Advance.along(self._goal, self._robot, np.array(self._time_s), np.array(self._nodes))
        if advance.crossed_s is not None:
            return now_s > advance.crossed_s + LASTING_S
        last_advance = int(np.argmax(advance.along_m > advance.along_m[-1] - GIVE_UP_M))
        self.gave_up = self._give_up_s is not None and now_s - self._time_s[last_advance] >= self._give_up_s
        return self.gave_up

    def _add_sample(self, black_box: BlackBox, first_row: int) -> bool:
        """Add the first row from a number on in which the pose is known. Returns False if there is none."""
        rows = black_box.layout.arrays(black_box.read_rows(first_row)[1])
        poses = zip(rows["position_w_m"], rows["orientation_wxyz"], rows["angle_rad"], strict=True)
        for i, pose in enumerate(poses):
            if all(np.isfinite(part).all() for part in pose):
                self._time_s.append(float(rows["time_s"][i]))
                self._nodes.append(find_nodes_w(self._robot, *pose))
                return True
        return False


def body_center_w(robot: Description, nodes: Floats) -> Floats:
    """Return the center of mass on the ground, (..., 2), of nodes (..., joints + 2, 3)."""
    masses_kg = np.array([link.mass_kg for link in robot.links])[:, None]
    link_centers_w = 0.5 * (nodes[..., :-1, :2] + nodes[..., 1:, :2])
    return (link_centers_w * masses_kg).sum(axis=-2) / masses_kg.sum()


def energy_j_per_m(record: RunRecord, advance: Advance) -> float | None:
    """Return the energy until the goal was reached or the end, over the advance until then."""
    if advance.reached_m < MIN_DISTANCE_M:
        return None
    return energy_j(record, record.time_s - record.time_s[0] <= advance.until_s) / advance.reached_m


def energy_j(record: RunRecord, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Return the sum over joints of |torque x velocity| over time; unknown values count as 0."""
    return float(np.nansum(np.abs(_power_w(record)[rows])) * _period_s(record))


def work_j(record: RunRecord, mode: Mode) -> float:
    """Return the work of the joints in a mode on the body, minus the work of the body on them."""
    return float(np.nansum(np.where(record.mode == mode, _power_w(record), 0.0)) * _period_s(record))


def _power_w(record: RunRecord) -> Floats:
    return record.torque_nm * record.velocity_rad_s


def _period_s(record: RunRecord) -> float:
    return record.config.period_ns * 1e-9

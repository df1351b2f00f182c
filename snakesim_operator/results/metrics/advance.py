"""How a run came on towards its mission's goal, what that cost, and for how long it stood still."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import nodes_w
from snakesim_hal.model.locomotion import MOVING_M, WINDOW_S
from snakesim_hal.model.scenario import HeadingGoal, RunConfig, WaypointGoal
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.wire.messages import Description, Mode
from snakesim_operator.results.record import RunRecord

SAMPLE_S = 0.1
LASTING_S = 0.5  # noise may take it back over the line
GIVE_UP_M = 0.03  # a run that does not come on so far within a given time has got stuck
MIN_DISTANCE_M = 0.1  # below it, energy per metre says nothing


@dataclass(frozen=True)
class Advance:
    """Samples of the body's place, ten a second or fewer."""

    goal: HeadingGoal | WaypointGoal | None
    time_s: Floats  # (m,) since the first row
    center_w: Floats  # (m, 2) center of mass
    head_w: Floats  # (m, 2)

    @staticmethod
    def of(record: RunRecord) -> "Advance | None":
        """None where the pose is never known."""
        posed = np.flatnonzero(record.posed)
        if len(posed) < 2:
            return None
        step = max(round(SAMPLE_S * record.config.rate_hz), 1)
        # Both ends of a stretch, so that nothing is interpolated over a gap that begins or ends between two samples.
        ends = [row for stretch in record.stretches for row in (stretch[0], stretch[-1]) if record.posed[row]]
        rows = np.unique(np.concatenate([posed[::step], posed[-1:], np.array(ends, dtype=np.int64)]))
        nodes = np.array([record.nodes_w(int(row)) for row in rows])
        return Advance.along(
            record.config.mission.goal, record.description, record.time_s[rows] - record.time_s[0], nodes
        )

    @staticmethod
    def along(goal: HeadingGoal | WaypointGoal | None, robot: Description, time_s: Floats, nodes: Floats) -> "Advance":
        """nodes: (m, joints + 2, 3), as of `nodes_w`."""
        return Advance(goal, time_s, body_center_w(robot, nodes), nodes[:, -1, :2])

    @property
    def goal_m(self) -> float | None:
        """How far it is to the goal; None without one."""
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
        """(m,) the largest advance towards the goal so far; without a goal that of the body along its first heading."""
        match self.goal:
            case HeadingGoal(heading_rad=heading):
                return self._projected(heading)
            case WaypointGoal() as goal:
                return np.maximum.accumulate(self._past_points(goal))
            case None:
                return self.along_heading_m

    @cached_property
    def along_heading_m(self) -> Floats:
        """(m,) the largest advance of the body so far along its first heading, from its center to its head."""
        forward = self.head_w[0] - self.center_w[0]
        return self._projected(float(np.arctan2(forward[1], forward[0])))

    @cached_property
    def crossed_s(self) -> float | None:
        """When the goal was reached; None if it was not, or there is none."""
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
        """When the goal was reached, or the end."""
        return float(self.time_s[-1]) if self.crossed_s is None else self.crossed_s

    @property
    def reached_m(self) -> float:
        """The advance until then."""
        return float(self.along_m[-1]) if self.crossed_s is None else float(self.goal_m or 0.0)

    @property
    def stalled_s(self) -> float:
        """For how long it stood until then."""
        within = max(round(WINDOW_S / SAMPLE_S), 1)
        if len(self.time_s) <= within:
            return 0.0
        moved = np.hypot(*(self.center_w[within:] - self.center_w[:-within]).T)
        lasts = np.diff(self.time_s)[within - 1 :]
        stood = (moved < MOVING_M) & (self.time_s[within:] <= self.until_s)
        return float(lasts[stood].sum())

    def _projected(self, heading_rad: float) -> Floats:
        forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
        return np.maximum.accumulate((self.center_w - self.center_w[0]) @ forward)

    def _past_points(self, goal: WaypointGoal) -> Floats:
        points = np.array(goal.points_m)
        to_go = np.append(np.cumsum(np.hypot(*np.diff(points, axis=0).T)[::-1])[::-1], 0.0)
        whole_m, next_point = self.goal_m or 0.0, 0
        along: list[float] = []
        for head in self.head_w:
            while next_point < len(points) and np.hypot(*(points[next_point] - head)) <= goal.within_m:
                next_point += 1
            left_m = np.hypot(*(points[next_point] - head)) + to_go[next_point] if next_point < len(points) else 0.0
            along.append(whole_m - float(left_m))
        return np.array(along)


class GoalWatch:
    """Tells during a run that nothing more will come of it: its goal has been reached for a while, or it is stuck."""

    def __init__(self, config: RunConfig, robot: Description, give_up_s: float | None = None) -> None:
        """give_up_s: robot time without an advance after which it is stuck; None: it never is."""
        self._goal, self._robot, self._give_up_s = config.mission.goal, robot, give_up_s
        self.gave_up = False
        self._time_s: list[float] = []
        self._nodes: list[Floats] = []

    def over(self, black_box: BlackBox) -> bool:
        """Take the newest row. True from LASTING_S after the goal, and when it is stuck."""
        if self._goal is None or not black_box.ticks:
            return False
        if not self._time_s:  # advance counts from the first pose
            self._take(black_box, 0)
        if not self._take(black_box, black_box.ticks - 1):
            return False
        advance = Advance.along(self._goal, self._robot, np.array(self._time_s), np.array(self._nodes))
        if advance.crossed_s is not None:
            return self._time_s[-1] > advance.crossed_s + LASTING_S
        since = int(np.argmax(advance.along_m > advance.along_m[-1] - GIVE_UP_M))
        self.gave_up = self._give_up_s is not None and self._time_s[-1] - self._time_s[since] >= self._give_up_s
        return self.gave_up

    def _take(self, black_box: BlackBox, number: int) -> bool:
        """Take the first row from that number on in which the pose is known; False when there is none."""
        rows = black_box.layout.arrays(black_box.rows_from(number)[1])
        poses = [rows[name] for name in ("position_w", "orientation_wxyz", "angle_rad")]
        for i, pose in enumerate(zip(*poses, strict=True)):
            if all(np.isfinite(one).all() for one in pose):
                self._time_s.append(float(rows["time_s"][i]))
                self._nodes.append(nodes_w(self._robot, *pose))
                return True
        return False


def body_center_w(robot: Description, nodes: Floats) -> Floats:
    """Centre of mass on the ground, (..., 2), of nodes (..., joints + 2, 3)."""
    masses = np.array([link.mass_kg for link in robot.links])[:, None]
    return (0.5 * (nodes[..., :-1, :2] + nodes[..., 1:, :2]) * masses).sum(axis=-2) / masses.sum()


def energy_j_per_m(record: RunRecord, advance: Advance) -> float | None:
    """Energy until the goal was reached or the end, over the advance until then."""
    if advance.reached_m < MIN_DISTANCE_M:
        return None
    return energy_j(record, record.time_s - record.time_s[0] <= advance.until_s) / advance.reached_m


def energy_j(record: RunRecord, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
    """Sum over joints of |torque x velocity| over time; unknown values count nothing."""
    return float(np.nansum(np.abs(_power_w(record)[rows])) * _period_s(record))


def work_j(record: RunRecord, mode: Mode) -> float:
    """What the joints in a mode gave to the body, less what they took from it."""
    return float(np.nansum(np.where(record.mode == mode, _power_w(record), 0.0)) * _period_s(record))


def _power_w(record: RunRecord) -> Floats:
    return record.torque_nm * record.velocity_rad_s


def _period_s(record: RunRecord) -> float:
    return record.config.period_ns * 1e-9

"""The planner through clutter: when a path is planned again, and the work on it, so much a turn. Pure.

The first path begins with the body's measured curve, from tail to head; ahead of the head it is what the search finds.
When it ends soon, when the map has changed, or when the body stands still, the path of the whole body is replanned,
close to where the body lies, with touches that can push. Paths on which it got stuck are remembered and avoided. Every
third time at one place it backs out first, along its own path and the trail of its tail.

A turn expands what the declared rate (`NODES_PER_S`) allows in its time, so nobody waits for a plan, and a plan comes
as late as its work takes, on every computer. Until it is there the path before counts, and `Trajectory.searching` says
why there will be another one.
"""

import math
from collections import deque
from collections.abc import Generator, Sequence

import numpy as np

from snakesim_gnc.navigation.beam import STEP_M, Search
from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_gnc.navigation.line import evenly
from snakesim_gnc.navigation.obstacle_map import ObstacleMap
from snakesim_gnc.navigation.plan import (
    AGAIN_M,
    BACKED_OUT,
    COMMITTED_M,
    ENDS_SOON,
    LOST,
    MAP_CHANGED,
    SHIFTED,
    STANDS,
    START,
    TRAIL,
    TURNED,
    Planned,
    Situation,
    plan,
    straight_on,
    within_reach,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Obstacle, Trajectory, World

NODES_PER_S = 250_000  # of robot time: two fifths of what a core expands, see docs/poal.md
ENDS_SOON_M = 0.6
SEEN_M, SAME_M = 1.5, 0.005  # obstacles within this distance of the head; a change that matters
LOST_M = 0.12  # median of the body's points; then no correction leads back
SHIFTED_M = 0.03  # likewise: control looks for contacts
TURNED_RAD = 0.35  # a change of direction that matters
FORGET_M = 0.15  # beyond this from where it was stuck, what failed there is forgotten
FAILURES = 4
BACK_EVERY = 3  # time at the same place: back out
BACK_M, BACK_S = 0.1, 1.5
SHORT_M = 0.01  # a body that was measured at its goal, and then stands so far before it, goes on
STANDS_S = 0.8
STANDS_M = 0.01


class ClutterPlanner:
    """Plans towards a goal, again and again."""

    def __init__(
        self,
        goal: HeadingGoal | WaypointGoal,
        known: Sequence[Obstacle] | None,
        *,
        search: Search,
        turn_s: float = 0.2,
    ) -> None:
        """goal: unless a heading is wished for. known: the surveyed obstacles; None: those of the world model.

        turn_s: from one update to the next, or the time until one is used if that is less.
        """
        self._goal = goal
        self._known = None if known is None else ObstacleMap(known)
        self._search = search
        self._nodes_a_turn = max(round(NODES_PER_S * turn_s), 1)
        again_nodes = round(AGAIN_M / STEP_M) * search.kept_nodes
        self._planning_s = (again_nodes / self._nodes_a_turn + 1) * turn_s  # until another path is there, and one turn
        self._planned: Planned | None = None
        self._planned_ns = 0
        self._path_id = self._path_id_shown = 0  # of the paths planned here from 1 on; 0 is a path from elsewhere
        self._plan: Generator[int, None, Planned] | None = None  # the one in work
        self._why, self._next_nodes = "", 0
        self._saved_nodes = 0  # of turns whose share was too small for the next step
        self.searched_nodes = 0  # in the last turn
        self._tick = -1
        self._start: Floats | None = None
        self._seen = np.empty((0, 5))
        self._recent: deque[tuple[int, Floats]] = deque()
        self._failed: list[Floats] = []  # paths on which the body got stuck near here
        self._stuck_at = 0.0
        self._stalls = 0
        self._back_from_m: float | None = None  # arc length of the head where backing out began
        self._back_by_m = 0.0
        self._back_until_ns = 0
        self._trail: list[Floats] = []
        self._aim, self._goal_w = np.zeros(2), np.zeros(2)
        self._finished = False
        self._next_point = 0
        self._headed_rad: float | None = None  # for which the present path was planned; None: for no direction

    @property
    def ready(self) -> bool:
        """Whether there is a path to follow."""
        return self._planned is not None and self._why != START

    def follow(self, route: Route, push_points: list[str]) -> None:
        """Somebody else's path is followed; a path that is planned later goes on from there."""
        self._planned, self._path_id_shown = Planned(route, push_points), 0
        self._plan, self._why, self._saved_nodes = None, "", 0
        self._headed_rad, self._back_from_m = None, None
        for memory in (self._recent, self._failed, self._trail):
            memory.clear()

    def update(self, tick: int, world: World, nodes_w: Floats, desired: DesiredMotion) -> Trajectory:
        """The trajectory. nodes_w: (n, 2) tail end, joints, head end."""
        body = evenly(nodes_w)
        if desired.heading_w_rad is None:
            self._aim = self._towards(body)
        else:
            self._aim = np.array([np.cos(desired.heading_w_rad), np.sin(desired.heading_w_rad)])
            self._goal_w = body[-1] + self._search.body_length_m * self._aim
            self._finished = False
        if tick != self._tick or not self.ready:  # a tick that is shown again is the same turn
            self._turn(body, world, desired)
        self._tick = tick
        planned, speed_m_s, reason = self._planned, desired.speed_m_s, desired.why[:500]
        assert planned is not None
        if self._finished:
            speed_m_s, reason = 0.0, "the goal is reached"
        elif self._why in (START, BACKED_OUT):
            speed_m_s, reason = 0.0, f"{self._why}: a path is being searched"
        elif self._back_from_m is not None:
            speed_m_s *= -0.5
        return Trajectory(
            tick=tick,
            timestamp_ns=world.timestamp_ns,
            path_id=self._path_id_shown,
            path_w=[(float(x), float(y)) for x, y in planned.route.points_w],
            speed_m_s=speed_m_s,
            push_points=planned.push_points,
            finished=self._finished,
            reason=reason,
            searching=self._why,
            searched_nodes=self.searched_nodes,
            peg_friction=self._search.peg_friction,
            goal_w=(float(self._goal_w[0]), float(self._goal_w[1])),
        )

    def _turn(self, body: Floats, world: World, desired: DesiredMotion) -> None:
        """Decide whether the path is to be planned again, and do a turn's share of a plan that is in work."""
        self.searched_nodes = 0
        self._leave_trail(body[0])
        if self._planned is None:
            self._planned, self._path_id_shown = Planned(Route(straight_on(body)), []), 0
            self._begin(START, body, world, 0.0)
        elif self._finished or desired.speed_m_s == 0.0:
            self._recent.clear()  # who is to stand still is not stuck
        else:
            committed_m = COMMITTED_M + max(desired.speed_m_s, 0.0) * self._planning_s
            moved_m = self._moved_m(body, world.timestamp_ns)
            if self._plan is None and (why := self._why_again(body, world, moved_m, committed_m)):
                self._begin(why, body, world, committed_m)
        if self._plan is not None:
            self._plan_on(world.timestamp_ns)

    def _begin(self, why: str, body: Floats, world: World, committed_m: float) -> None:
        """Begin to plan again, from where the body is now."""
        assert self._planned is not None
        self._headed_rad = within_reach(body, self._aim)
        if self._known is None:
            self._seen = _shapes_near(body[-1], world.obstacles)
        situation = Situation(
            why=why,
            body_w=body,
            goal=self._aim,
            obstacles=self._known or world.obstacles,
            route=self._planned.route,
            committed_m=committed_m,
            failed_w=np.concatenate(self._failed) if self._failed else None,
            trail_w=list(self._trail),
        )
        self._plan, self._why = plan(situation, self._search), why
        self._next_nodes = next(self._plan)

    def _plan_on(self, now_ns: int) -> None:
        """A turn's share of the plan; puts its path in place when it is there."""
        assert self._plan is not None
        left = self._saved_nodes + self._nodes_a_turn
        while self._next_nodes <= left:
            left -= self._next_nodes
            self.searched_nodes += self._next_nodes
            try:
                self._next_nodes = next(self._plan)
            except StopIteration as done:
                self._planned, self._planned_ns = done.value, now_ns
                self._path_id += 1
                self._path_id_shown = self._path_id
                if self._why != MAP_CHANGED:  # a map that keeps changing must not hide that the body stands
                    self._recent.clear()
                self._plan, self._why, self._saved_nodes = None, "", 0
                return
        self._saved_nodes = 0 if self.searched_nodes else left

    def _moved_m(self, body: Floats, now_ns: int) -> float | None:
        """How far the body's middle has moved within STANDS_S; None: not known for as long."""
        recent, middle = self._recent, body.mean(axis=0)
        recent.append((now_ns, middle))
        while now_ns - recent[0][0] > STANDS_S * 1e9:
            recent.popleft()
        if now_ns - recent[0][0] <= 0.8e9 * STANDS_S:
            return None
        return float(np.hypot(*(middle - recent[0][1])))

    def _towards(self, body: Floats) -> Floats:
        """Unit vector of the goal's direction; notes where it is, and when it is reached."""
        if isinstance(self._goal, HeadingGoal):
            heading = self._goal.heading_rad
            goal = np.array([np.cos(heading), np.sin(heading)])
            middle = body.mean(axis=0)
            if self._start is None:
                self._start = middle
                self._goal_w = middle + (self._goal.distance_m + self._search.body_length_m) * goal
            left_m = self._goal.distance_m - float((middle - self._start) @ goal)
            self._finished = left_m <= (SHORT_M if self._finished else 0.0)
            return goal
        points = np.array(self._goal.points_m)
        while np.hypot(*(points[self._next_point] - body[-1])) < self._goal.within_m:
            if self._next_point == len(points) - 1:
                self._finished = True
                break
            self._next_point += 1
        self._goal_w = points[self._next_point]
        ahead = self._goal_w - body[-1]
        return ahead / max(float(np.hypot(*ahead)), 1e-9)

    def _why_again(self, body: Floats, world: World, moved_m: float | None, committed_m: float) -> str:
        """Why the path is to be replanned; empty when it is not. Decides about backing out, too."""
        planned, now_ns = self._planned, world.timestamp_ns
        assert planned is not None
        head_s = planned.route.project(body[-1])
        if self._back_from_m is not None:
            if self._back_from_m - head_s > self._back_by_m or now_ns > self._back_until_ns:
                self._back_from_m = None
                return BACKED_OUT
            return ""
        off_m = np.median([_off_m(planned.route, point) for point in body[::10]])
        if off_m > LOST_M:
            return LOST
        if self._failed and off_m > SHIFTED_M and now_ns - self._planned_ns > STANDS_S * 1e9:
            return SHIFTED
        if planned.route.length_m - head_s < ENDS_SOON_M + committed_m - COMMITTED_M:
            return ENDS_SOON
        if moved_m is not None and moved_m < STANDS_M:
            return self._stuck(planned, body, head_s, now_ns)
        headed_rad, heading_rad = self._headed_rad, within_reach(body, self._aim)
        turned = headed_rad is None or abs(math.remainder(heading_rad - headed_rad, math.tau)) > TURNED_RAD
        if turned and not self._failed:
            return TURNED
        if self._known is None and not self._failed and self._seen_anew(body[-1], world.obstacles):
            return MAP_CHANGED
        return ""

    def _seen_anew(self, head: Floats, obstacles: Sequence[Obstacle]) -> bool:
        """Whether the map around the head is another than when it was planned."""
        before, shapes = self._seen, _shapes_near(head, obstacles)
        return len(before) != len(shapes) or bool(len(shapes) and np.abs(before - shapes).max() >= SAME_M)

    def _stuck(self, planned: Planned, body: Floats, head_s: float, now_ns: int) -> str:
        """Remember the path; every third time at a place back out first."""
        place = float(body.mean(axis=0) @ self._aim)
        if self._failed and abs(place - self._stuck_at) > FORGET_M:
            self._failed.clear()
        if not self._failed:
            self._stuck_at, self._stalls = place, 0
        tail_s = planned.route.project(body[0])
        self._failed.append(planned.route.position_w(np.arange(tail_s, head_s + 0.1, 0.025)))
        self._failed = self._failed[-FAILURES:]
        self._stalls += 1
        if self._stalls % BACK_EVERY:
            return STANDS
        self._back_from_m, self._back_by_m = head_s, BACK_M
        self._back_until_ns = now_ns + round(BACK_S * 1e9)
        return ""

    def _leave_trail(self, tail: Floats) -> None:
        """Where the tail was: the way back."""
        trail = self._trail
        if not trail or np.hypot(*(trail[-1] - tail)) > 0.03:
            ahead = len(trail) > 1 and float((tail - trail[-1]) @ (trail[-1] - trail[-2])) < 0
            if ahead:
                trail.pop()
            else:
                trail.append(tail)
            del trail[: -2 * TRAIL]


def _shapes_near(head: Floats, obstacles: Sequence[Obstacle]) -> Floats:
    """Places and shapes of the obstacles around the head, one row each."""
    outlines = Outlines.of(obstacles)
    near = np.hypot(*(outlines.center_w - head).T) < SEEN_M
    return np.column_stack([outlines.center_w, outlines.half_m, outlines.rounding_m])[near]


def _off_m(route: Route, point_w: Floats) -> float:
    """Distance of a point from a route."""
    return float(np.hypot(*(route.position_w(route.project(point_w)) - point_w)))

"""The planner through clutter: a path for the whole body, from where it lies to where the goal is. Pure.

The first path begins with the body's measured curve, from tail to head; ahead of the head it is what the search finds.
When it ends soon, when the map has changed, or when the body stands still, the path of the whole body is replanned,
close to where the body lies, with touches that can push. Paths on which it got stuck are remembered and avoided. Every
third time at one place it backs out first, along its own path and the trail of its tail.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.beam import MIN_PUSH, STEP_M, Beam, PlannedPath, Search
from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_gnc.navigation.line import SPACING_M, evenly
from snakesim_gnc.navigation.obstacle_map import NONE, ObstacleMap
from snakesim_gnc.navigation.snap import Fit, snap
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Obstacle, Trajectory, World

Floats = NDArray[np.float64]

HORIZON_M = 4.4
AGAIN_M = 2.0
REACHES_M = (0.05, 0.09)
ENDS_SOON_M = 0.6
COMMITTED_M = 0.1  # of the path ahead of the head that is not changed any more
SEEN_M, SAME_M = 1.5, 0.005  # obstacles within this distance of the head; a change that matters
ENDS_SOON, MAP_CHANGED, TURNED = "ends soon", "the map has changed", "the direction has changed"
LOST, LOST_M = "the body is off its path", 0.12  # median of its points; then no correction leads back
SHIFTED, SHIFTED_M = "the body has left the place where it stood", 0.03  # likewise: control looks for contacts
TURNED_RAD = 0.35  # a change of direction that matters
SHARPEST_RAD = 1.2  # a path begins with no greater turn from where the head points; further ones follow
FORGET_M = 0.15  # beyond this from where it was stuck, what failed there is forgotten
FAILURES = 4
FIRST_WIDTH, FIRST_CROWD = 2700, 48  # of the search of the first path on a known map
MIN_AHEAD = 10  # arcs of a new path beyond the head
BACK_EVERY = 3  # time at the same place: back out
BACK_M, BACK_S = 0.1, 1.5
TRAIL = 20  # points of the way behind the tail
JOIN_M = 0.1  # between them and a path: nearer, and beside its begin, they would fold it
STANDS_S = 0.8
MAX_REPORTED = 512  # push-points in a message
STANDS_M = 0.01


@dataclass(frozen=True)
class Planned:
    """A path, its number, and what the body is to push off on it."""

    route: Route
    path_id: int
    push_points: list[str]


class ClutterPlanner:
    """Plans towards a goal, again and again."""

    def __init__(
        self,
        goal: HeadingGoal | WaypointGoal,
        known: Sequence[Obstacle] | None,
        *,
        search: Search,
    ) -> None:
        """goal: unless a heading is wished for. known: the surveyed obstacles; None: those of the world model."""
        self._goal = goal
        self._known = None if known is None else ObstacleMap(known)
        self._search = search
        self._fit = Fit(radius_m=search.radius_m, segment_m=search.segment_m)
        self._planned: Planned | None = None
        self._planned_ns = 0
        self._path_id = 0
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
        self._aim = np.zeros(2)
        self._finished = False
        self._next_point = 0
        self._headed_rad = 0.0  # for which the present path was planned

    def update(self, tick: int, world: World, nodes_w: Floats, desired: DesiredMotion) -> Trajectory:
        """The trajectory. nodes_w: (n, 2) tail end, joints, head end."""
        body = evenly(nodes_w)
        if desired.heading_w_rad is None:
            goal = self._aim = self._towards(body)
        else:
            goal = self._aim = np.array([np.cos(desired.heading_w_rad), np.sin(desired.heading_w_rad)])
            self._finished = False
        self._leave_trail(body[0])
        resting = self._planned is not None and (self._finished or desired.speed_m_s == 0.0)
        if resting:
            self._recent.clear()  # who is to stand still is not stuck
        elif why := self._why_again(body, world):
            self._plan(body, self._known or ObstacleMap(world.obstacles), goal, why)
            self._planned_ns = world.stamp_ns
        planned = self._planned
        assert planned is not None
        return Trajectory(
            tick=tick,
            stamp_ns=world.stamp_ns,
            path_id=planned.path_id,
            path_w=[(float(x), float(y)) for x, y in planned.route.points_w],
            speed_m_s=0.0 if self._finished else self._speed_m_s(desired.speed_m_s),
            push_points=planned.push_points,
            finished=self._finished,
            reason="the goal is reached" if self._finished else desired.why[:500],
        )

    def _speed_m_s(self, wanted_m_s: float) -> float:
        return wanted_m_s if self._back_from_m is None else -0.5 * wanted_m_s

    def _towards(self, body: Floats) -> Floats:
        """Unit vector of the goal's direction; notes when it is reached."""
        if isinstance(self._goal, HeadingGoal):
            heading = self._goal.heading_rad
            goal = np.array([np.cos(heading), np.sin(heading)])
            middle = body.mean(axis=0)
            if self._start is None:
                self._start = middle
            self._finished |= bool((middle - self._start) @ goal >= self._goal.distance_m)
            return goal
        points = np.array(self._goal.points_m)
        while np.hypot(*(points[self._next_point] - body[-1])) < self._goal.within_m:
            if self._next_point == len(points) - 1:
                self._finished = True
                break
            self._next_point += 1
        ahead = points[self._next_point] - body[-1]
        return ahead / max(float(np.hypot(*ahead)), 1e-9)

    def _why_again(self, body: Floats, world: World) -> str:
        """Why the path is to be replanned; empty when it is not. Decides about backing out, too."""
        planned, now_ns = self._planned, world.stamp_ns
        if planned is None:
            return "start"
        head_s = planned.route.project(body[-1])
        recent, middle = self._recent, body.mean(axis=0)
        recent.append((now_ns, middle))
        while now_ns - recent[0][0] > STANDS_S * 1e9:
            recent.popleft()
        moved, full = float(np.hypot(*(middle - recent[0][1]))), now_ns - recent[0][0] > 0.8e9 * STANDS_S
        if self._back_from_m is not None:
            if self._back_from_m - head_s > self._back_by_m or now_ns > self._back_until_ns:
                self._back_from_m = None
                return "backed out"
            return ""
        off_m = np.median([_off_m(planned.route, point) for point in body[::10]])
        if off_m > LOST_M:
            return LOST
        if self._failed and off_m > SHIFTED_M and now_ns - self._planned_ns > STANDS_S * 1e9:
            return SHIFTED
        if planned.route.length_m - head_s < ENDS_SOON_M:
            return ENDS_SOON
        if full and moved < STANDS_M:
            return self._stuck(planned, body, head_s, now_ns)
        turned_rad = math.remainder(_within_reach(body, self._aim) - self._headed_rad, math.tau)
        if abs(turned_rad) > TURNED_RAD and not self._failed:
            return TURNED
        if self._known is None and not self._failed and self._seen_anew(body[-1], world.obstacles):
            return MAP_CHANGED
        return ""

    def _seen_anew(self, head: Floats, obstacles: Sequence[Obstacle]) -> bool:
        """Whether the map around the head is another than when it was planned."""
        outlines = Outlines.of(obstacles)
        near = np.hypot(*(outlines.centre_w - head).T) < SEEN_M
        shapes = np.column_stack([outlines.centre_w, outlines.half_m, outlines.rounding_m])[near]
        before, self._seen = self._seen, shapes
        if len(before) == len(shapes) and (not len(shapes) or np.abs(before - shapes).max() < SAME_M):
            self._seen = before
            return False
        return True

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
            return "stands"
        self._back_from_m, self._back_by_m = head_s, BACK_M
        self._back_until_ns = now_ns + round(BACK_S * 1e9)
        return ""

    def _plan(self, body: Floats, obstacles: ObstacleMap, goal: Floats, why: str) -> None:
        goal_rad = self._headed_rad = _within_reach(body, goal)
        search = self._search
        if self._planned is None and self._known is not None:  # nobody waits for it while something moves
            search = replace(search, width=FIRST_WIDTH, crowd=FIRST_CROWD)
        beam = Beam(obstacles, search)
        if why in (ENDS_SOON, MAP_CHANGED, TURNED):
            found, kept, points = self._onward(beam, body, goal_rad)
        elif self._planned is None or why in (LOST, SHIFTED):
            horizon_m = AGAIN_M if why == SHIFTED else HORIZON_M
            found, kept = beam.ahead(body, goal_rad, round(horizon_m / STEP_M)), len(body) - 3
            points = body if found is None else np.concatenate([body, evenly(found.points_w)[1:]])
        else:
            found, kept = self._replanned(beam, body, goal_rad), 0
            points = body if found is None else evenly(found.points_w)
        if found is not None:
            points = snap(points, kept, obstacles, goal, self._fit)
        else:
            ahead = body[-1] - body[-4]
            points = np.concatenate([body, body[-1] + np.linspace(0.1, 1.0, 10)[:, None] * ahead / np.hypot(*ahead)])
        self._path_id += 1
        if why != MAP_CHANGED:  # a map that keeps changing must not hide that the body stands
            self._recent.clear()
        along = points[5] - points[0]
        along /= max(float(np.hypot(*along)), 1e-9)
        behind = [place for place in self._trail if (place - points[0]) @ along < -JOIN_M][-TRAIL:]
        if behind:
            points = np.concatenate([np.array(behind), points])
        self._planned = Planned(Route(points), self._path_id, self._pushed_off(points, obstacles, goal))

    def _onward(self, beam: Beam, body: Floats, goal_rad: float) -> tuple[PlannedPath | None, int, Floats]:
        """The present path as far as the body lies on it and a little further, then another one."""
        assert self._planned is not None
        route = self._planned.route
        tail_s = route.project(body[0])
        head_s = route.project(body[-1], tail_s + self._search.body_length_m)
        lies = body  # where a path that crosses itself does not tell the order of tail and head
        if head_s - tail_s > 0.5 * self._search.body_length_m:
            lies = evenly(route.position_w(np.arange(tail_s, head_s + COMMITTED_M, SPACING_M)))
        found = beam.ahead(lies, goal_rad, round(AGAIN_M / STEP_M))
        points = lies if found is None else np.concatenate([lies, evenly(found.points_w)[1:]])
        return found, len(lies) - 3, points

    def _replanned(self, beam: Beam, body: Floats, goal_rad: float) -> PlannedPath | None:
        """A path for the whole body: the least change of shape that can push well."""
        failed = np.concatenate(self._failed) if self._failed else None
        best: PlannedPath | None = None
        for reach_m in REACHES_M:
            found = beam.whole(body, goal_rad, round(AGAIN_M / STEP_M), reach_m, failed)
            arcs = round(self._search.body_length_m / STEP_M)
            if found is None or len(found.points_w) < arcs + MIN_AHEAD:
                continue
            if best is None or found.cost < best.cost - 0.1:
                best = found
            if np.min(found.margins_n[arcs : arcs + 6]) > 0.5 * self._search.wanted_n:
                break
        return best

    def _pushed_off(self, points: Floats, obstacles: ObstacleMap, goal: Floats) -> list[str]:
        """Obstacles that a body on the path touches or nearly does, and that push it on, in order along the path."""
        near = obstacles.near(points[:, 0], points[:, 1])
        beside = (near.distance_m < self._search.radius_m + self._fit.touch_m) & (near.normal_w @ goal > MIN_PUSH)
        found = dict.fromkeys(near.obstacle[beside & (near.obstacle != NONE)].tolist())
        return [obstacles.obstacles[k].name for k in found][:MAX_REPORTED]

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


def _within_reach(body: Floats, goal: Floats) -> float:
    """Heading of a goal's direction, or as far towards it as the head can turn on one path."""
    x, y = body[-1] - body[-4]
    head_rad = math.atan2(y, x)
    turn_rad = math.remainder(math.atan2(goal[1], goal[0]) - head_rad, math.tau)
    return head_rad + min(max(turn_rad, -SHARPEST_RAD), SHARPEST_RAD)


def _off_m(route: Route, point_w: Floats) -> float:
    """Distance of a point from a route."""
    return float(np.hypot(*(route.position_w(route.project(point_w)) - point_w)))

"""The planner through clutter: a path for the whole body, from where it lies to where the goal is. Pure.

The path begins with the body's measured curve, from tail to head, so that the body is on its path by construction. Ahead
of the head it is what the search finds. It is planned anew when it ends soon, when the body has left it, when the map has
changed near it, or when the body stands still.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.beam import STEP_M, Beam, Found, Search
from snakesim_gnc.navigation.intents import Intents
from snakesim_gnc.navigation.obstacle_map import ObstacleMap
from snakesim_gnc.navigation.snap import SPACING_M, Fit, resample, snap
from snakesim_hal.model.route import Route
from snakesim_hal.model.scenario import HeadingGoal, WaypointGoal
from snakesim_hal.wire.messages import Intent, Obstacle, Trajectory, World

Floats = NDArray[np.float64]

HORIZON_M = 4.0
AGAIN_M = 2.0
REACHES_M = (0.06, 0.1)
ENDS_SOON_M = 0.6
OFF_PATH_M = 0.06
STANDS_S = 1.0
STANDS_M = 0.01


@dataclass(frozen=True)
class Planned:
    """A path, and what was thought of it."""

    route: Route
    path_id: int
    body_m: float  # arc length of the head on it when it was planned
    found: Found | None


class ClutterPlanner:
    """Plans towards a goal, again and again."""

    def __init__(
        self,
        goal: HeadingGoal | WaypointGoal,
        known: Sequence[Obstacle] | None,
        *,
        speed_m_s: float,
        search: Search,
    ) -> None:
        """known: the surveyed obstacles; None: those of the world model."""
        self._goal = goal
        self._known = None if known is None else ObstacleMap(known)
        self._intents = Intents(speed_m_s)
        self._search = search
        self._fit = Fit(radius_m=search.radius_m, segment_m=search.segment_m)
        self.start_over()

    def start_over(self) -> None:
        """Another robot, or another start."""
        self._planned: Planned | None = None
        self._path_id = 0
        self._start: Floats | None = None
        self._recent: deque[tuple[int, float]] = deque()
        self._banned: list[Floats] = []
        self._finished = False
        self._next_point = 0
        self.replans: list[str] = []

    def update(
        self, tick: int, now_ns: int, world: World | None, nodes_w: Floats | None, intent: Intent | None
    ) -> Trajectory | None:
        """The trajectory; None until the body is known. nodes_w: (n, 2) tail end, joints, head end."""
        wish = self._intents.wish(intent, now_ns)
        if world is None or nodes_w is None:
            return None
        body = resample(nodes_w)
        obstacles = self._known or ObstacleMap(world.obstacles)
        goal = self._towards(body)
        why = self._why_again(body, world.stamp_ns)
        if why:
            self._plan(body, obstacles, goal, why)
        planned = self._planned
        assert planned is not None
        return Trajectory(
            tick=tick,
            stamp_ns=world.stamp_ns,
            path_id=planned.path_id,
            path_w=[(float(x), float(y)) for x, y in planned.route.points_w],
            speed_m_s=0.0 if self._finished else wish.speed_m_s,
            push_points=[],
            finished=self._finished,
            reason="the goal is reached" if self._finished else wish.why[:500],
        )

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

    def _why_again(self, body: Floats, now_ns: int) -> str:
        planned = self._planned
        if planned is None:
            return "start"
        route = planned.route
        head_s = route.project(body[-1])
        recent = self._recent
        recent.append((now_ns, head_s))
        while now_ns - recent[0][0] > STANDS_S * 1e9:
            recent.popleft()
        if route.length_m - head_s < ENDS_SOON_M:
            return "ends soon"
        off = max(float(np.hypot(*(route.position_w(route.project(p)) - p))) for p in body[::10])
        if off > OFF_PATH_M:
            return f"off path {off * 1e3:.0f} mm"
        if now_ns - recent[0][0] > 0.8e9 * STANDS_S and head_s - recent[0][1] < STANDS_M:
            return "stands"
        return ""

    def _plan(self, body: Floats, obstacles: ObstacleMap, goal: Floats, why: str) -> None:
        self.replans.append(f"{why} at {body[-1][0]:.2f}")
        beam, goal_rad = Beam(obstacles, self._search), float(np.arctan2(goal[1], goal[0]))
        found, kept = None, 0
        if self._planned is None:
            found, kept = beam.ahead(body, goal_rad, round(HORIZON_M / STEP_M)), len(body) - 3
            points = body if found is None else np.concatenate([body, resample(found.points_w)[1:]])
        else:
            for reach_m in REACHES_M:
                found = beam.whole(body, goal_rad, round(AGAIN_M / STEP_M), reach_m)
                if found is not None:
                    break
            points = body if found is None else resample(found.points_w)
        if found is not None:
            points = snap(points, kept, obstacles, goal, self._fit)
        else:
            ahead = body[-1] - body[-4]
            points = np.concatenate([body, body[-1] + np.linspace(0.1, 1.0, 10)[:, None] * ahead / np.hypot(*ahead)])
        self._path_id += 1
        self._recent.clear()
        self._planned = Planned(Route(points), self._path_id, SPACING_M * len(body), found)

"""The planner of the case study: the path is known; speed and progress are what is decided. Pure."""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.messages import Intent, Obstacle, Trajectory, World
from snakesim_hal.route import Route
from snakesim_hal.scene import outline_distance_m

PUSH_REACH_M = 0.15  # an obstacle whose outline is nearer to the path than this can be pushed on
PUSH_POINTS_AHEAD_M = 3.0


class KnownPath:
    """Follows one route at the mission's speed, or at the speed that an operator asks for."""

    def __init__(self, route: Route, obstacles: Sequence[Obstacle], *, speed_m_s: float) -> None:
        self._route = route
        self._path = [(float(x), float(y)) for x, y in route.points_w]
        self._speed_m_s = speed_m_s
        found: list[tuple[float, str]] = []
        for obstacle in obstacles:
            s = route.project(np.array(obstacle.position_w[:2]))
            if outline_distance_m(obstacle, route.position_w(s)) < PUSH_REACH_M:
                found.append((s, obstacle.name))
        self._push_points = sorted(found)
        self._tail_s_m: float | None = None

    def update(self, tick: int, stamp_ns: int, world: World | None, intent: Intent | None) -> Trajectory:
        """The trajectory from where the body is now."""
        if world is not None:
            tail = np.array(world.base_position_w[:2])
            self._tail_s_m = self._route.project(tail, self._tail_s_m)
        tail_s_m = self._tail_s_m or 0.0
        finished = tail_s_m >= self._route.length_m
        speed = self._speed_m_s if intent is None or intent.speed_m_s is None else intent.speed_m_s
        if finished or (intent is not None and not intent.go):
            speed = 0.0
        ahead = [name for s, name in self._push_points if tail_s_m <= s <= tail_s_m + PUSH_POINTS_AHEAD_M]
        return Trajectory(
            tick=tick,
            stamp_ns=stamp_ns,
            path_id=0,
            path_w=self._path,
            speed_m_s=speed,
            push_points=ahead,
            finished=finished,
        )

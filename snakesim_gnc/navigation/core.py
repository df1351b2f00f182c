"""The planner of the case study: the path is given; it decides speed and progress. Pure."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_hal.model.outlines import outline_distance_m
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Obstacle, Trajectory, World

PUSH_REACH_M = 0.15  # an obstacle whose outline is nearer to the path than this can be pushed on
PUSH_POINTS_AHEAD_M = 3.0


class KnownPath:
    """Follows one route at the speed that is wished for."""

    def __init__(self, route: Route, obstacles: Sequence[Obstacle], peg_friction: float = 0.0) -> None:
        self.route = route
        self._peg_friction = peg_friction
        self._path = [(float(x), float(y)) for x, y in route.points_w]
        found: list[tuple[float, str]] = []
        for obstacle in obstacles:
            s = route.project(np.array(obstacle.position_w[:2]))
            if outline_distance_m(obstacle, route.position_w(s)) < PUSH_REACH_M:
                found.append((s, obstacle.name))
        self._push_points = sorted(found)
        self._tail_s_m: float | None = None

    def update(self, tick: int, world: World | None, desired: DesiredMotion) -> Trajectory:
        """The trajectory from where the body was by this world model; its stamp is the world model's."""
        if world is not None:
            tail = np.array(world.base_position_w[:2])
            self._tail_s_m = self.route.project(tail, self._tail_s_m)
        finished = self._tail_s_m is not None and self._tail_s_m >= self.route.length_m
        return Trajectory(
            tick=tick,
            timestamp_ns=None if world is None else world.timestamp_ns,
            path_id=0,
            path_w=self._path,
            speed_m_s=0.0 if finished else desired.speed_m_s,
            push_points=self._ahead(),
            finished=finished,
            reason="the path is finished" if finished else desired.why[:500],
            peg_friction=self._peg_friction,
        )

    def _ahead(self) -> list[str]:
        tail_s_m = self._tail_s_m
        if tail_s_m is None:
            return []
        return [name for s, name in self._push_points if tail_s_m <= s <= tail_s_m + PUSH_POINTS_AHEAD_M]

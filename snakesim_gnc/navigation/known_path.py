"""The planner of the case study: the path is given, and the planner decides speed and progress. Pure."""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.navigation.intents import DesiredMotion
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle, Trajectory, WorldModel

# The body can push on an obstacle whose outline is nearer to the path than this.
MAX_PUSH_DISTANCE_M = 0.15
PUSH_POINTS_AHEAD_M = 3.0  # length of path whose push-points are reported
MAX_REASON_LENGTH = 500


class KnownPath:
    """Follows one route at the desired speed."""

    def __init__(
        self,
        route: Route,
        obstacles: Sequence[KnownObstacle],
        assumed_obstacle_friction: float = 0.0,
    ) -> None:
        """Prepare to follow a route, and find the push-points beside it.

        Args:
            route: The route to follow.
            obstacles: The known obstacles.
            assumed_obstacle_friction: Coulomb friction coefficient of obstacles, which becomes part of the trajectory.
        """
        self.route = route
        self._assumed_obstacle_friction = assumed_obstacle_friction
        self._path_points_w = [(float(x), float(y)) for x, y in route.points_w]
        self._push_points = _find_push_points_beside_route(route, obstacles)
        self._tail_s_m: float | None = None

    def update(self, tick: int, world: WorldModel | None, desired: DesiredMotion) -> Trajectory:
        """Return the trajectory along the route from the current position of the body.

        Args:
            tick: Tick of the clock.
            world: The newest world model, whose timestamp the trajectory gets; None if there is none yet.
            desired: Desired speed.
        """
        if world is not None:
            tail_w = np.array(world.base_position_w[:2])
            self._tail_s_m = self.route.project_point(tail_w, self._tail_s_m)
        finished = self._tail_s_m is not None and self._tail_s_m >= self.route.length_m
        return Trajectory(
            tick=tick,
            timestamp_ns=None if world is None else world.timestamp_ns,
            path_id=0,
            path_w=self._path_points_w,
            speed_m_s=0.0 if finished else desired.speed_m_s,
            push_points=self._list_push_points_ahead(),
            finished=finished,
            reason="the path is finished" if finished else desired.reason[:MAX_REASON_LENGTH],
            assumed_obstacle_friction=self._assumed_obstacle_friction,
        )

    def _list_push_points_ahead(self) -> list[str]:
        """Return the names of the push-points from the tail on, in order along the path."""
        tail_s_m = self._tail_s_m
        if tail_s_m is None:
            return []
        return [
            name
            for s_m, name in self._push_points
            if tail_s_m <= s_m <= tail_s_m + PUSH_POINTS_AHEAD_M
        ]


def _find_push_points_beside_route(
    route: Route, obstacles: Sequence[KnownObstacle]
) -> list[tuple[float, str]]:
    """Return arc length in m and name of the obstacles beside a route, in order along it."""
    push_points: list[tuple[float, str]] = []
    for obstacle in obstacles:
        s_m = route.project_point(np.array(obstacle.position_w[:2]))
        if (
            compute_outline_distance_m(obstacle, route.compute_positions_w(s_m))
            < MAX_PUSH_DISTANCE_M
        ):
            push_points.append((s_m, obstacle.name))
    return sorted(push_points)

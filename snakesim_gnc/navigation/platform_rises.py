"""Where a path leads over platforms: low obstacles of a survey that a snake may lie on. Pure."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle, PathRise

SAMPLE_SPACING_M = 0.01  # of the points of the path that are checked
MAX_RISES = 64  # in a message


class PlatformRises:
    """Finds the rises of the current path, once for each path."""

    def __init__(self, platforms: Sequence[KnownObstacle]) -> None:
        self._outlines = ObstacleOutlines.from_obstacles(platforms)
        self._tops_m = np.array(
            [platform.position_w[2] + 0.5 * platform.height_m for platform in platforms]
        )
        self._path_id = -1
        self._rises: list[PathRise] = []

    def find_rises(self, path_id: int, path_w: Sequence[tuple[float, float]]) -> list[PathRise]:
        """Return the rises along a path, which are computed only when the path is a new one.

        Args:
            path_id: Number of the path, which changes when the path does.
            path_w: Points of the path in the world, m.
        """
        if len(self._tops_m) and path_id != self._path_id:
            self._path_id = path_id
            self._rises = self._compute_rises(Route(path_w))
        return self._rises

    def _compute_rises(self, route: Route) -> list[PathRise]:
        """Find the stretches of a route on platforms, at points every SAMPLE_SPACING_M, at most MAX_RISES."""
        s_m = np.arange(0.0, route.length_m, SAMPLE_SPACING_M)
        # (points, platforms).
        distances_m = self._outlines.compute_distances_m(route.compute_positions_w(s_m))
        is_on_platform = distances_m <= 0.0
        heights_m = np.where(is_on_platform, self._tops_m, 0.0).max(axis=1)
        points = zip(s_m.tolist(), heights_m.tolist(), strict=True)
        rises: list[PathRise] = []
        for height_m, same_height_points in groupby(points, key=lambda point: point[1]):
            if height_m > 0.0:
                rise_s_m = [s for s, _ in same_height_points]
                rises.append(PathRise(from_s_m=rise_s_m[0], to_s_m=rise_s_m[-1], height_m=height_m))
        return rises[:MAX_RISES]

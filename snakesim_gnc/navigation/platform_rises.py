"""Where a path leads over platforms: low obstacles of a survey that a snake may lie on. Pure."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Obstacle, Rise

SPACING_M = 0.01  # of the points of the path that are checked
MAX_RISES = 64  # in a message


class PlatformRises:
    """Finds the rises of the present path, once for each path."""

    def __init__(self, platforms: Sequence[Obstacle]) -> None:
        self._outlines = Outlines.from_obstacles(platforms)
        self._tops_m = np.array([platform.position_w[2] + 0.5 * platform.height_m for platform in platforms])
        self._path_id = -1
        self._rises: list[Rise] = []

    def find_rises(self, path_id: int, path_w: Sequence[tuple[float, float]]) -> list[Rise]:
        """Return the rises along a path. path_id: changes when the path does."""
        if len(self._tops_m) and path_id != self._path_id:
            self._path_id = path_id
            self._rises = self._compute_rises(Route(path_w))
        return self._rises

    def _compute_rises(self, route: Route) -> list[Rise]:
        s_m = np.arange(0.0, route.length_m, SPACING_M)
        is_on_platform = self._outlines.distance_m(route.position_w(s_m)) <= 0.0  # (points, platforms)
        heights_m = np.where(is_on_platform, self._tops_m, 0.0).max(axis=1)
        points = zip(s_m.tolist(), heights_m.tolist(), strict=True)
        rises: list[Rise] = []
        for height_m, run in groupby(points, key=lambda point: point[1]):
            if height_m > 0.0:
                run_s_m = [s for s, _ in run]
                rises.append(Rise(from_s_m=run_s_m[0], to_s_m=run_s_m[-1], height_m=height_m))
        return rises[:MAX_RISES]

"""Where a path leads over platforms: low things that a snake may lie on, as the survey has them. Pure."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.route import Route
from snakesim_hal.wire.messages import Obstacle, Rise

SPACING_M = 0.01
MOST = 64  # of a message


class Rises:
    """Rises of the present path."""

    def __init__(self, platforms: Sequence[Obstacle]) -> None:
        self._outlines = Outlines.of(platforms)
        self._tops_m = np.array([one.position_w[2] + 0.5 * one.height_m for one in platforms])
        self._path_id, self._found = -1, list[Rise]()

    def along(self, path_id: int, path_w: Sequence[tuple[float, float]]) -> list[Rise]:
        """Of a path, which changes when its id does."""
        if len(self._tops_m) and path_id != self._path_id:
            self._path_id, self._found = path_id, self._along(Route(path_w))
        return self._found

    def _along(self, route: Route) -> list[Rise]:
        s_m = np.arange(0.0, route.length_m, SPACING_M)
        on_top = self._outlines.distance_m(route.position_w(s_m)) <= 0.0
        heights_m = np.where(on_top, self._tops_m, 0.0).max(axis=1).tolist()
        found: list[Rise] = []
        for height_m, run in groupby(zip(s_m.tolist(), heights_m, strict=True), key=lambda point: point[1]):
            if height_m > 0.0:
                points = list(run)
                found.append(Rise(from_s_m=points[0][0], to_s_m=points[-1][0], height_m=height_m))
        return found[:MOST]

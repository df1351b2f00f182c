"""The obstacles around the body as arrays: the nearest one to each of many points, at once. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

CELL_M = 0.01
REACH_M = 0.30  # beyond this distance from every surface a point counts as free
NONE = -1


@dataclass(frozen=True)
class Near:
    """The obstacle nearest to each point; all arrays have the points' shape."""

    obstacle: Ints  # its index; NONE: there is none within REACH_M
    distance_m: Floats  # to its surface, negative inside; REACH_M where there is none
    normal_w: Floats  # (..., 2), from its surface to the point; zero where there is none


class ObstacleMap:
    """A grid of cells that know their nearest obstacle; distances are exact for that obstacle.

    With gaps between obstacles that are wider than the body, the nearest obstacle is the only one it can touch there.
    """

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        self.obstacles = list(obstacles)
        self.outlines = outlines = Outlines.of(self.obstacles)
        reach = outlines.reach_m + REACH_M
        if not len(outlines):
            self._low, self._shape = np.zeros(2), (1, 1)
            self._nearest = np.full(1, NONE, dtype=np.intp)
            return
        self._low = (outlines.centre_w - reach[:, None]).min(axis=0)
        high = (outlines.centre_w + reach[:, None]).max(axis=0)
        nx, ny = (np.ceil((high - self._low) / CELL_M).astype(int) + 1).tolist()
        self._shape = (nx, ny)
        nearest = np.full((nx, ny), NONE, dtype=np.intp)
        least = np.full((nx, ny), REACH_M)
        for i, (centre, around) in enumerate(zip(outlines.centre_w, reach, strict=True)):
            first = np.maximum(((centre - around - self._low) / CELL_M).astype(int), 0)
            last = np.minimum(((centre + around - self._low) / CELL_M).astype(int) + 2, (nx, ny))
            x = self._low[0] + CELL_M * np.arange(first[0], last[0])
            y = self._low[1] + CELL_M * np.arange(first[1], last[1])
            window = (slice(first[0], last[0]), slice(first[1], last[1]))
            distance = self._distances(x[:, None], y[None, :], np.intp(i))[0]
            nearer = distance < least[window]
            least[window][nearer] = distance[nearer]
            nearest[window][nearer] = i
        self._nearest = nearest.ravel()

    def near(self, x: Floats, y: Floats) -> Near:
        """The nearest obstacle to points; x and y of one shape."""
        shape = np.shape(x)
        cell_x = ((x - self._low[0]) / CELL_M + 0.5).astype(int)
        cell_y = ((y - self._low[1]) / CELL_M + 0.5).astype(int)
        inside = (cell_x >= 0) & (cell_y >= 0) & (cell_x < self._shape[0]) & (cell_y < self._shape[1])
        found = np.where(inside, self._nearest[np.where(inside, cell_x * self._shape[1] + cell_y, 0)], NONE)
        distance, normal = np.full(shape, REACH_M), np.zeros((*shape, 2))
        some = found >= 0
        if some.any():
            distance[some], normal[some] = self._distances(x[some], y[some], found[some])
        return Near(found, distance, normal)

    def _distances(self, x: Floats, y: Floats, of: Ints | np.intp) -> tuple[Floats, Floats]:
        """Distance to the surface of one obstacle each, and the normal (..., 2) from it."""
        outlines = self.outlines
        c, s = outlines.turn[of, 0], outlines.turn[of, 1]
        dx, dy = x - outlines.centre_w[of, 0], y - outlines.centre_w[of, 1]
        local_x, local_y = c * dx + s * dy, c * dy - s * dx
        over_x, over_y = np.abs(local_x) - outlines.half_m[of, 0], np.abs(local_y) - outlines.half_m[of, 1]
        out_x, out_y = np.maximum(over_x, 0.0), np.maximum(over_y, 0.0)
        outside = np.hypot(out_x, out_y)
        sunk = np.maximum(over_x, over_y)
        distance = outside + np.minimum(sunk, 0.0) - outlines.rounding_m[of]
        free = outside > 0
        length = np.where(free, outside, 1.0)
        nx = np.where(free, out_x / length, over_x >= over_y) * np.where(local_x < 0, -1.0, 1.0)
        ny = np.where(free, out_y / length, over_x < over_y) * np.where(local_y < 0, -1.0, 1.0)
        return distance, np.stack([c * nx - s * ny, s * nx + c * ny], axis=-1)

"""The obstacles around the body as arrays: the nearest one to each of many points, at once. Pure."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

Ints = NDArray[np.intp]

CELL_M = 0.01
ROUGH_M = CELL_M * 0.5**0.5  # from a cell's center to its corner
REACH_M = 0.30  # beyond this distance from every surface a point counts as free
NONE = -1
STEP_OBSTACLES = 20
OBSTACLE_NODES = 100  # that a search (`beam`) could expand in the time that an obstacle takes


@dataclass(frozen=True)
class NearestObstacles:
    """The obstacle nearest to each point; all arrays have the points' shape."""

    obstacle: Ints  # its index; NONE: there is none within REACH_M
    distance_m: Floats  # to its surface, negative inside; REACH_M where there is none
    normal_w: Floats  # (..., 2), from its surface to the point; zero where there is none


class ObstacleMap:
    """A grid of cells that know their nearest obstacle; distances are exact for that obstacle.

    With gaps between obstacles that are wider than the body, the nearest obstacle is the only one it can touch there.
    """

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        for _ in self._marking(obstacles):
            pass

    @classmethod
    def in_steps(cls, obstacles: Sequence[Obstacle]) -> "Generator[int, None, ObstacleMap]":
        """The same, made step by step; yields what its next step costs, in nodes to expand, before it does it."""
        made = cls.__new__(cls)
        yield from made._marking(obstacles)
        return made

    def _marking(self, obstacles: Sequence[Obstacle]) -> Generator[int, None, None]:
        self.obstacles = list(obstacles)
        self.outlines = outlines = Outlines.of(self.obstacles)
        reach = outlines.reach_m + REACH_M
        if not len(outlines):
            self._low, self._shape = np.zeros(2), (1, 1)
            self._nearest, self._min_m = np.full(1, NONE, dtype=np.intp), np.full(1, REACH_M)
            return
        self._low = (outlines.center_w - reach[:, None]).min(axis=0)
        high = (outlines.center_w + reach[:, None]).max(axis=0)
        nx, ny = (np.ceil((high - self._low) / CELL_M).astype(int) + 1).tolist()
        self._shape = (nx, ny)
        nearest = np.full((nx, ny), NONE, dtype=np.intp)
        least = np.full((nx, ny), REACH_M)
        for i, (center, around) in enumerate(zip(outlines.center_w, reach, strict=True)):
            if i % STEP_OBSTACLES == 0:
                yield OBSTACLE_NODES * min(STEP_OBSTACLES, len(outlines) - i)
            first = np.maximum(((center - around - self._low) / CELL_M).astype(int), 0)
            last = np.minimum(((center + around - self._low) / CELL_M).astype(int) + 2, (nx, ny))
            x = self._low[0] + CELL_M * np.arange(first[0], last[0])
            y = self._low[1] + CELL_M * np.arange(first[1], last[1])
            window = (slice(first[0], last[0]), slice(first[1], last[1]))
            cells = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
            distance = outlines.towards(cells, np.full(cells.shape[:2], i))[0]
            nearer = distance < least[window]
            least[window][nearer] = distance[nearer]
            nearest[window][nearer] = i
        self._nearest, self._min_m = nearest.ravel(), least.ravel()

    def roughly_m(self, x: Floats, y: Floats) -> Floats:
        """Distance to the nearest surface at most ROUGH_M too great or small; REACH_M and more are free."""
        inside, cell = self._cell(x, y)
        return np.where(inside, self._min_m[cell], REACH_M)

    def near(self, x: Floats, y: Floats) -> NearestObstacles:
        """The nearest obstacle to points; x and y of one shape."""
        shape = np.shape(x)
        inside, cell = self._cell(x, y)
        found = np.where(inside, self._nearest[cell], NONE)
        distance, normal = np.full(shape, REACH_M), np.zeros((*shape, 2))
        some = found >= 0
        if some.any():
            distance[some], normal[some] = self.outlines.towards(np.stack([x[some], y[some]], axis=-1), found[some])
        return NearestObstacles(found, distance, normal)

    def _cell(self, x: Floats, y: Floats) -> tuple[NDArray[np.bool_], Ints]:
        """Whether points are in the grid, and the index of their cell, 0 for the others."""
        cell_x = ((x - self._low[0]) / CELL_M + 0.5).astype(int)
        cell_y = ((y - self._low[1]) / CELL_M + 0.5).astype(int)
        inside = (cell_x >= 0) & (cell_y >= 0) & (cell_x < self._shape[0]) & (cell_y < self._shape[1])
        return inside, np.where(inside, cell_x * self._shape[1] + cell_y, 0)

"""A grid that finds the obstacle nearest to each of many points in one call. Pure."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

Ints = NDArray[np.intp]

CELL_M = 0.01
CELL_ERROR_M = CELL_M * 0.5**0.5  # distance from a cell's center to its corner
MAX_DISTANCE_M = 0.30  # a point farther than this from every surface counts as free
NO_OBSTACLE = -1
OBSTACLES_PER_STEP = 20
NODES_PER_OBSTACLE = 100  # nodes that a search (`beam`) could expand in the time that one obstacle takes


@dataclass(frozen=True)
class NearestObstacles:
    """The obstacle nearest to each point. All arrays have the shape of the points."""

    obstacle: Ints  # (...) index; NO_OBSTACLE if none is within MAX_DISTANCE_M
    distance_m: Floats  # (...) to its surface, negative inside; MAX_DISTANCE_M if there is none
    normal_w: Floats  # (..., 2) unit vector from its surface to the point; zero if there is none


class ObstacleGrid:
    """A grid of cells that store their nearest obstacle; distances are exact for that obstacle.

    Where gaps between obstacles are wider than the body, the body can touch no other obstacle than the nearest one.
    """

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        for _ in self._fill(obstacles):
            pass

    @classmethod
    def build_in_steps(cls, obstacles: Sequence[Obstacle]) -> "Generator[int, None, ObstacleGrid]":
        """Build a grid step by step and return it.

        Yields:
            The cost of the next step in nodes, before doing it. See `beam`.
        """
        grid = cls.__new__(cls)
        yield from grid._fill(obstacles)
        return grid

    def _fill(self, obstacles: Sequence[Obstacle]) -> Generator[int, None, None]:
        self.obstacles = list(obstacles)
        self.outlines = Outlines.from_obstacles(self.obstacles)
        if not self.obstacles:
            self._fill_empty()
            return
        outlines = self.outlines
        reach_m = outlines.reach_m + MAX_DISTANCE_M
        self.low_w = (outlines.center_w - reach_m[:, None]).min(axis=0)
        high_w = (outlines.center_w + reach_m[:, None]).max(axis=0)
        columns, rows = (np.ceil((high_w - self.low_w) / CELL_M).astype(int) + 1).tolist()
        self.shape = (columns, rows)
        nearest = np.full(self.shape, NO_OBSTACLE, dtype=np.intp)
        distance_m = np.full(self.shape, MAX_DISTANCE_M)
        for index, (center_w, radius_m) in enumerate(zip(outlines.center_w, reach_m, strict=True)):
            if index % OBSTACLES_PER_STEP == 0:
                yield NODES_PER_OBSTACLE * min(OBSTACLES_PER_STEP, len(outlines) - index)
            self._mark_obstacle(index, center_w, radius_m, nearest, distance_m)
        self.cell_nearest = nearest.ravel()
        self.cell_distance_m = distance_m.ravel()

    def _fill_empty(self) -> None:
        """Make a grid of one cell, which is free."""
        self.low_w = np.zeros(2)
        self.shape = (1, 1)
        self.cell_nearest = np.full(1, NO_OBSTACLE, dtype=np.intp)
        self.cell_distance_m = np.full(1, MAX_DISTANCE_M)

    def _mark_obstacle(self, index: int, center_w: Floats, radius_m: float, nearest: Ints, distance_m: Floats) -> None:
        """Write an obstacle into the cells within a radius of its center that have no nearer one."""
        first = np.maximum(((center_w - radius_m - self.low_w) / CELL_M).astype(int), 0)
        last = np.minimum(((center_w + radius_m - self.low_w) / CELL_M).astype(int) + 2, self.shape)
        x = self.low_w[0] + CELL_M * np.arange(first[0], last[0])
        y = self.low_w[1] + CELL_M * np.arange(first[1], last[1])
        cells_w = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        to_obstacle_m, _ = self.outlines.distance_and_normal(cells_w, np.full(cells_w.shape[:2], index))
        window = (slice(first[0], last[0]), slice(first[1], last[1]))
        is_nearer = to_obstacle_m < distance_m[window]
        distance_m[window][is_nearer] = to_obstacle_m[is_nearer]
        nearest[window][is_nearer] = index

    def approximate_distance_m(self, x: Floats, y: Floats) -> Floats:
        """Return distances to the nearest surface with an error of at most CELL_ERROR_M.

        Points without an obstacle within MAX_DISTANCE_M get MAX_DISTANCE_M.
        """
        is_inside, cell = self._find_cells(x, y)
        return np.where(is_inside, self.cell_distance_m[cell], MAX_DISTANCE_M)

    def find_nearest(self, x: Floats, y: Floats) -> NearestObstacles:
        """Find the obstacle nearest to each point of the world, with the exact distance. x, y: arrays of one shape."""
        shape = np.shape(x)
        is_inside, cell = self._find_cells(x, y)
        obstacle = np.where(is_inside, self.cell_nearest[cell], NO_OBSTACLE)
        distance_m = np.full(shape, MAX_DISTANCE_M)
        normal_w = np.zeros((*shape, 2))
        has_obstacle = obstacle >= 0
        if has_obstacle.any():
            points_w = np.stack([x[has_obstacle], y[has_obstacle]], axis=-1)
            distances_m, normals_w = self.outlines.distance_and_normal(points_w, obstacle[has_obstacle])
            distance_m[has_obstacle] = distances_m
            normal_w[has_obstacle] = normals_w
        return NearestObstacles(obstacle, distance_m, normal_w)

    def _find_cells(self, x: Floats, y: Floats) -> tuple[NDArray[np.bool_], Ints]:
        """Return which points are in the grid, and the index of their cell, 0 for points outside."""
        columns, rows = self.shape
        column = ((x - self.low_w[0]) / CELL_M + 0.5).astype(int)
        row = ((y - self.low_w[1]) / CELL_M + 0.5).astype(int)
        is_inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        return is_inside, np.where(is_inside, column * rows + row, 0)

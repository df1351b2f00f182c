"""A grid that finds the obstacle nearest to each of many points in one call. Pure."""

import ctypes
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.path_search.native_library import (
    INTEGER_DTYPE,
    NativeGrid,
    NativeMemory,
    NativeWindow,
    PlannerLibrary,
    load_library,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle

Ints = NDArray[np.int64]

CELL_M = 0.01
CELL_ERROR_M = CELL_M * 0.5**0.5  # distance from a cell's center to its corner
MAX_DISTANCE_M = 0.30  # a point farther than this from every surface counts as free
NO_OBSTACLE = -1
OBSTACLES_PER_STEP = 20
# Nodes that a search (`beam`) could expand in the time that one obstacle takes.
NODE_COST_PER_OBSTACLE = 100


@dataclass(frozen=True)
class NearestObstacles:
    """The obstacle nearest to each point. All arrays have the shape of the points."""

    obstacle_index: Ints  # (...) index; NO_OBSTACLE if none is within MAX_DISTANCE_M
    distance_m: Floats  # (...) to its surface, negative inside; MAX_DISTANCE_M if there is none
    normal_w: Floats  # (..., 2) unit vector from its surface to the point; zero if there is none


class ObstacleGrid:
    """A grid of cells that store their nearest obstacle; distances are exact for that obstacle.

    Where gaps between obstacles are wider than the body, the body can touch no other obstacle than the nearest one.
    """

    def __init__(self, obstacles: Sequence[KnownObstacle]) -> None:
        for _ in self._compute_nearest_obstacles_incrementally(obstacles):
            pass

    @classmethod
    def build_in_steps(
        cls, obstacles: Sequence[KnownObstacle]
    ) -> "Generator[int, None, ObstacleGrid]":
        """Build a grid step by step and return it.

        Yields:
            The cost of the next step in nodes, before doing it. See `beam`.
        """
        grid = cls.__new__(cls)
        yield from grid._compute_nearest_obstacles_incrementally(obstacles)
        return grid

    def _compute_nearest_obstacles_incrementally(
        self, obstacles: Sequence[KnownObstacle]
    ) -> Generator[int, None, None]:
        """Compute the distance field: the nearest obstacle of each cell, and its distance.

        The computation is a generator, whose steps a planner can spread over several ticks.

        Each obstacle is written into the cells within MAX_DISTANCE_M of its outline that have no nearer obstacle.

        Args:
            obstacles: The obstacles of the map.

        Yields:
            Cost of the following step, in units of one expanded node of the path search.
        """
        self.obstacles = list(obstacles)
        self.outlines = ObstacleOutlines.from_obstacles(self.obstacles)
        if not self.obstacles:
            self._fill_empty()
            return
        outlines = self.outlines
        influence_radius_m = outlines.bounding_radius_m + MAX_DISTANCE_M
        self.min_corner_w = (outlines.center_w - influence_radius_m[:, None]).min(axis=0)
        max_corner_w = (outlines.center_w + influence_radius_m[:, None]).max(axis=0)
        # One more cell, so that the corner itself has one.
        column_count, row_count = (
            np.ceil((max_corner_w - self.min_corner_w) / CELL_M).astype(int) + 1
        ).tolist()
        self.shape = (column_count, row_count)
        self.nearest_obstacle_by_cell = np.full(
            column_count * row_count, NO_OBSTACLE, dtype=np.int64
        )
        self.cell_distance_m = np.full(column_count * row_count, MAX_DISTANCE_M)
        # Writes one obstacle into a window of cells: compiled, or the same in Python.
        mark_obstacle = self._choose_marking_function()
        for index, (center_w, radius_m) in enumerate(
            zip(outlines.center_w, influence_radius_m, strict=True)
        ):
            if index % OBSTACLES_PER_STEP == 0:
                yield NODE_COST_PER_OBSTACLE * min(OBSTACLES_PER_STEP, len(outlines) - index)
            # The last cell is exclusive: + 1 because `astype` rounds down, + 1 for a cell of margin.
            first_cell = np.maximum(
                ((center_w - radius_m - self.min_corner_w) / CELL_M).astype(int), 0
            )
            last_cell = np.minimum(
                ((center_w + radius_m - self.min_corner_w) / CELL_M).astype(int) + 2, self.shape
            )
            mark_obstacle(index, first_cell, last_cell)

    def _fill_empty(self) -> None:
        """Make a grid of one cell, which is free."""
        self.min_corner_w = np.zeros(2)
        self.shape = (1, 1)
        self.nearest_obstacle_by_cell = np.full(1, NO_OBSTACLE, dtype=np.int64)
        self.cell_distance_m = np.full(1, MAX_DISTANCE_M)

    def _choose_marking_function(self) -> Callable[[int, Ints, Ints], None]:
        """Return the function that writes an obstacle into the grid: in C if the library is installed, else NumPy."""
        library = load_library()
        if library is None:
            return self._mark_obstacle_with_numpy
        return NativeObstacleMarker(library, self).mark_obstacle

    def _mark_obstacle_with_numpy(self, index: int, first_cell: Ints, last_cell: Ints) -> None:
        """Write an obstacle into the cells of a window that have no nearer one.

        It is the reference implementation of a function of the C library, which gives the same result.

        Args:
            index: Index of the obstacle.
            first_cell: (2,) column and row of the first cell.
            last_cell: (2,) column and row after the last cell; both are within the grid.
        """
        x = self.min_corner_w[0] + CELL_M * np.arange(first_cell[0], last_cell[0])
        y = self.min_corner_w[1] + CELL_M * np.arange(first_cell[1], last_cell[1])
        cells_w = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        to_obstacle_m, _ = self.outlines.compute_distances_and_normals(
            cells_w, np.full(cells_w.shape[:2], index)
        )
        window = (slice(first_cell[0], last_cell[0]), slice(first_cell[1], last_cell[1]))
        distance_m = self.cell_distance_m.reshape(self.shape)[window]
        nearest = self.nearest_obstacle_by_cell.reshape(self.shape)[window]
        is_nearer = to_obstacle_m < distance_m
        distance_m[is_nearer] = to_obstacle_m[is_nearer]
        nearest[is_nearer] = index

    def make_native_grid(self, memory: NativeMemory) -> NativeGrid:
        """Return the grid as the structure that the functions of the C library read, with pointers to its arrays.

        Args:
            memory: Keeps the arrays alive as long as C code may read them.
        """
        columns, rows = self.shape
        outlines = self.outlines
        count = len(outlines)
        grid = NativeGrid()
        grid.low_x_m, grid.low_y_m = self.min_corner_w
        grid.columns = columns
        grid.rows = rows
        grid.cell_m = CELL_M
        grid.cell_error_m = CELL_ERROR_M
        grid.max_distance_m = MAX_DISTANCE_M
        cells = (columns * rows,)
        grid.nearest = memory.get_array_address(
            "the nearest obstacle of each cell", self.nearest_obstacle_by_cell, cells, INTEGER_DTYPE
        )
        grid.distance_m = memory.get_array_address(
            "the distance of each cell", self.cell_distance_m, cells
        )
        grid.center_m = memory.get_array_address(
            "the centers of the obstacles", outlines.center_w, (count, 2)
        )
        grid.direction = memory.get_array_address(
            "the directions of the obstacles", outlines.direction, (count, 2)
        )
        grid.half_size_m = memory.get_array_address(
            "the half sizes of the obstacles", outlines.half_m, (count, 2)
        )
        grid.rounding_m = memory.get_array_address(
            "the roundings of the obstacles", outlines.rounding_m, (count,)
        )
        return grid

    def compute_approximate_distance_m(self, x: Floats, y: Floats) -> Floats:
        """Return distances to the nearest surface with an error of at most CELL_ERROR_M.

        Points without an obstacle within MAX_DISTANCE_M get MAX_DISTANCE_M.
        """
        is_inside, cell = self._find_cells(x, y)
        return np.where(is_inside, self.cell_distance_m[cell], MAX_DISTANCE_M)

    def find_nearest(self, x: Floats, y: Floats) -> NearestObstacles:
        """Find the obstacle nearest to each point, with the exact distance and normal.

        Args:
            x: (...) positions in the world, m.
            y: (...) positions in the world, m.
        """
        shape = np.shape(x)
        is_inside, cell = self._find_cells(x, y)
        obstacle = np.where(is_inside, self.nearest_obstacle_by_cell[cell], NO_OBSTACLE)
        distance_m = np.full(shape, MAX_DISTANCE_M)
        normal_w = np.zeros((*shape, 2))
        has_obstacle = obstacle >= 0
        if has_obstacle.any():
            points_w = np.stack([x[has_obstacle], y[has_obstacle]], axis=-1)
            distances_m, normals_w = self.outlines.compute_distances_and_normals(
                points_w, obstacle[has_obstacle]
            )
            distance_m[has_obstacle] = distances_m
            normal_w[has_obstacle] = normals_w
        return NearestObstacles(obstacle, distance_m, normal_w)

    def _find_cells(self, x: Floats, y: Floats) -> tuple[NDArray[np.bool_], Ints]:
        """Find the cells of points.

        Args:
            x: (...) positions in the world, m.
            y: (...) positions in the world, m.

        Returns:
            Whether each point is in the grid, and the flat index of its cell, 0 for points outside; (...) each.
        """
        columns, rows = self.shape
        column = ((x - self.min_corner_w[0]) / CELL_M + 0.5).astype(int)
        row = ((y - self.min_corner_w[1]) / CELL_M + 0.5).astype(int)
        is_inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        return is_inside, np.where(is_inside, column * rows + row, 0)


class NativeObstacleMarker:
    """Writes obstacles into the cells of a grid by a function of the C library."""

    def __init__(self, library: PlannerLibrary, grid: ObstacleGrid) -> None:
        self._library = library
        self._memory = NativeMemory()
        self._grid = grid.make_native_grid(self._memory)

    def mark_obstacle(self, index: int, first_cell: Ints, last_cell: Ints) -> None:
        """Write an obstacle into the cells of a window that have no nearer one; see `ObstacleGrid`."""
        window = NativeWindow(
            int(first_cell[0]), int(last_cell[0]), int(first_cell[1]), int(last_cell[1])
        )
        self._library.mark_obstacle(ctypes.byref(self._grid), ctypes.byref(window), index)

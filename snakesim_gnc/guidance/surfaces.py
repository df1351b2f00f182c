"""What is known of one obstacle's surface: points, fused in cells of a grid. Pure.

A cell holds the weighted mean of what was measured in it. The weight is its information in 1 / m², so each cell is an
information filter of its own. The number of cells is bounded for an obstacle of any size: when there are too many, the
cells become larger.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

CELL_M = 0.01
CELL_GROWTH = 1.5
MAX_CELLS = 48
MAX_INFORMATION = 1.0 / 0.0015**2  # errors of pose and mount are common to all points, and do not average out
MAX_NORMAL_INFORMATION = 1e5
MIN_TOUCH_RATIO = 0.2  # of a cell's information that touches must have, so that it has a normal
COMMON_VARIANCE_RATIO = 0.05  # of one measurement's variance that a cell's mean keeps, however many it is the mean of
MAX_DOUBTS = 3  # scans that may see through a cell before it is dropped


def _no_cells(*shape: int) -> Floats:
    return np.empty(shape)


@dataclass
class Surface:
    """Cells in the world; n is their number."""

    points_w: Floats = field(default_factory=lambda: _no_cells(0, 2))  # (n, 2)
    weight: Floats = field(default_factory=lambda: _no_cells(0))  # (n,) information in 1 / m²
    outward_w: Floats = field(default_factory=lambda: _no_cells(0, 2))  # (n, 2) towards the sensor; of a touch, normal
    normal_weight: Floats = field(default_factory=lambda: _no_cells(0))  # (n,) information of a normal; 0: only seen
    count: Floats = field(default_factory=lambda: _no_cells(0))  # (n,) measurements, as far as the weight counts them
    doubts: Floats = field(default_factory=lambda: _no_cells(0))  # (n,) scans that saw through it
    cell_m: float = CELL_M

    def __len__(self) -> int:
        return len(self.weight)

    def add(self, points_w: Floats, sd_m: Floats, outward_w: Floats, normal_weight: Floats | None = None) -> None:
        """Add measured points, and merge them with the points in the same grid cell.

        The cells become larger until there are no more than MAX_CELLS.

        Args:
            points_w: (k, 2) points in the world, m.
            sd_m: (k,) their standard deviations.
            outward_w: (k, 2) unit vectors towards the sensor, or the normals of touches.
            normal_weight: (k,) information of `outward_w` as normals; None for points that were only seen.
        """
        if normal_weight is None:
            normal_weight = np.zeros(len(points_w))
        points = np.vstack([self.points_w, points_w])
        weight = np.concatenate([self.weight, 1.0 / np.square(sd_m)])
        outward = np.vstack([self.outward_w, outward_w])
        normal = np.concatenate([self.normal_weight, normal_weight])
        count = np.concatenate([self.count, np.ones(len(normal_weight))])
        doubts = np.concatenate([self.doubts, np.zeros(len(normal_weight))])
        self._fuse(points, weight, outward, normal, count, doubts)
        while len(self) > MAX_CELLS:
            self.cell_m *= CELL_GROWTH
            self._fuse(self.points_w, self.weight, self.outward_w, self.normal_weight, self.count, self.doubts)

    def add_surface(self, other: "Surface") -> None:
        """Add the cells of another surface."""
        self.add(other.points_w, 1.0 / np.sqrt(other.weight), other.outward_w, other.normal_weight)

    def keep(self, selected: NDArray[np.bool_]) -> None:
        """Drop the cells that are not selected, (n,)."""
        if selected.all():
            return
        self.points_w = self.points_w[selected]
        self.weight = self.weight[selected]
        self.outward_w = self.outward_w[selected]
        self.normal_weight = self.normal_weight[selected]
        self.count = self.count[selected]
        self.doubts = self.doubts[selected]

    def drift(self, variance_m2: float) -> None:
        """Lower the information, because the robot's position has become less certain since the measurements."""
        self.weight = 1.0 / (1.0 / self.weight + variance_m2)

    def _fuse(
        self, points: Floats, weight: Floats, outward: Floats, normal: Floats, count: Floats, doubts: Floats
    ) -> None:
        """Replace all cells by points that are merged within each cell of the grid.

        Args:
            points: (k, 2) points in the world, m.
            weight: (k,) information of the points in 1 / m².
            outward: (k, 2) unit vectors out of the surface.
            normal: (k,) information of `outward` as normals; 0 for points that were only seen.
            count: (k,) number of measurements in each point.
            doubts: (k,) number of scans that saw through each point.
        """
        # One integer identifies a grid cell: the cell number along x in the upper bits, along y in the lower ones.
        cell_numbers = np.floor(points / self.cell_m).astype(np.int64) @ np.array([1 << 31, 1])
        _, cell = np.unique(cell_numbers, return_inverse=True)
        total = np.bincount(cell, weight)

        def mean(values: Floats) -> Floats:
            return np.bincount(cell, weight * values) / total

        self.points_w = np.stack([mean(points[:, 0]), mean(points[:, 1])], axis=1)
        mean_outward = np.stack([mean(outward[:, 0]), mean(outward[:, 1])], axis=1)
        length = np.maximum(np.hypot(mean_outward[:, 0], mean_outward[:, 1]), 1e-9)
        self.outward_w = mean_outward / length[:, None]
        self.weight = np.minimum(total, MAX_INFORMATION)
        self.count = np.bincount(cell, count) * self.weight / total

        touch_weight = np.bincount(cell, np.where(normal > 0, weight, 0.0))
        has_normal = touch_weight > MIN_TOUCH_RATIO * total
        self.normal_weight = np.minimum(np.bincount(cell, normal), MAX_NORMAL_INFORMATION) * has_normal

        self.doubts = np.full(len(total), np.inf)
        np.minimum.at(self.doubts, cell, doubts)


def stack_surfaces(surfaces: list[Surface]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the cells of b surfaces as arrays, padded to the largest number of cells p.

    Args:
        surfaces: the surfaces of b obstacles, of which some may have no cells.

    Returns:
        Points (b, p, 2) in m, weights (b, p) in 1 / m², outward directions (b, p, 2), normal weights (b, p). Padding
        has the weight 0.
    """
    shape = (len(surfaces), max(len(surface) for surface in surfaces))
    points = np.zeros((*shape, 2))
    outward = np.zeros((*shape, 2))
    weight = np.zeros(shape)
    normal_weight = np.zeros(shape)
    for row, surface in enumerate(surfaces):
        cells = len(surface)
        points[row, :cells] = surface.points_w
        points[row, cells:] = surface.points_w[0] if cells else 0.0
        outward[row, :cells] = surface.outward_w
        weight[row, :cells] = surface.weight / (1.0 + COMMON_VARIANCE_RATIO * surface.count)
        normal_weight[row, :cells] = surface.normal_weight
    return points, weight, outward, normal_weight

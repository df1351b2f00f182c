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
CELL_GROWTH_FACTOR = 1.5
MAX_CELLS = 48
# Errors of pose and mount are common to all points, and do not average out.
MAX_INFORMATION = 1.0 / 0.0015**2
MAX_NORMAL_INFORMATION = 1e5
MIN_TOUCH_RATIO = 0.2  # of a cell's information that touches must have, so that it has a normal
# Of one measurement's variance that a cell's mean keeps, however many it is the mean of.
COMMON_VARIANCE_RATIO = 0.05
MAX_SEEN_THROUGH_COUNT = 3  # scans that may see through a cell before it is dropped


def _make_empty_array(*shape: int) -> Floats:
    return np.empty(shape)


@dataclass
class SurfaceCells:
    """Cells in the world; n is their number."""

    points_w: Floats = field(default_factory=lambda: _make_empty_array(0, 2))  # (n, 2)
    # (n,) information in 1 / m².
    weights: Floats = field(default_factory=lambda: _make_empty_array(0))
    # (n, 2) unit vectors towards the sensor, or the normal of a touch
    outward_directions_w: Floats = field(default_factory=lambda: _make_empty_array(0, 2))
    # (n,) information of the direction as a normal; 0 if the cell was only seen
    normal_weights: Floats = field(default_factory=lambda: _make_empty_array(0))
    # (n,) number of measurements, as far as the weight counts them
    measurement_counts: Floats = field(default_factory=lambda: _make_empty_array(0))
    # (n,) scans that saw through it.
    seen_through_counts: Floats = field(default_factory=lambda: _make_empty_array(0))
    cell_m: float = CELL_M

    def __len__(self) -> int:
        return len(self.weights)

    def add(
        self,
        points_w: Floats,
        sd_m: Floats,
        outward_directions_w: Floats,
        normal_weights: Floats | None = None,
    ) -> None:
        """Add measured points, and merge them with the points in the same grid cell.

        The cells become larger until there are no more than MAX_CELLS.

        Args:
            points_w: (k, 2) points in the world, m.
            sd_m: (k,) their standard deviations.
            outward_directions_w: (k, 2) unit vectors towards the sensor, or the normals of touches.
            normal_weights: (k,) information of `outward_directions_w` as normals; None for points that were only seen.
        """
        if normal_weights is None:
            normal_weights = np.zeros(len(points_w))
        all_points = np.vstack([self.points_w, points_w])
        all_weights = np.concatenate([self.weights, 1.0 / np.square(sd_m)])
        all_directions = np.vstack([self.outward_directions_w, outward_directions_w])
        all_normal_weights = np.concatenate([self.normal_weights, normal_weights])
        all_counts = np.concatenate([self.measurement_counts, np.ones(len(normal_weights))])
        all_seen_through_counts = np.concatenate(
            [self.seen_through_counts, np.zeros(len(normal_weights))]
        )
        self._fuse_in_cells(
            all_points,
            all_weights,
            all_directions,
            all_normal_weights,
            all_counts,
            all_seen_through_counts,
        )
        while len(self) > MAX_CELLS:
            self.cell_m *= CELL_GROWTH_FACTOR
            self._fuse_in_cells(
                self.points_w,
                self.weights,
                self.outward_directions_w,
                self.normal_weights,
                self.measurement_counts,
                self.seen_through_counts,
            )

    def add_surface(self, other: "SurfaceCells") -> None:
        """Add the cells of another surface."""
        self.add(
            other.points_w,
            1.0 / np.sqrt(other.weights),
            other.outward_directions_w,
            other.normal_weights,
        )

    def keep_cells(self, is_kept: NDArray[np.bool_]) -> None:
        """Drop all cells except for those that are marked in an array (n,)."""
        if is_kept.all():
            return
        self.points_w = self.points_w[is_kept]
        self.weights = self.weights[is_kept]
        self.outward_directions_w = self.outward_directions_w[is_kept]
        self.normal_weights = self.normal_weights[is_kept]
        self.measurement_counts = self.measurement_counts[is_kept]
        self.seen_through_counts = self.seen_through_counts[is_kept]

    def add_variance(self, variance_m2: float) -> None:
        """Add a variance to every cell, because the robot's position has become less certain since the measurements."""
        self.weights = 1.0 / (1.0 / self.weights + variance_m2)

    def _fuse_in_cells(
        self,
        points: Floats,
        weights: Floats,
        outward_directions: Floats,
        normal_weights: Floats,
        measurement_counts: Floats,
        seen_through_counts: Floats,
    ) -> None:
        """Replace all cells by points that are merged within each cell of the grid.

        Args:
            points: (k, 2) points in the world, m.
            weights: (k,) information of the points in 1 / m².
            outward_directions: (k, 2) unit vectors out of the surface.
            normal_weights: (k,) information of `outward_directions` as normals; 0 for points that were only seen.
            measurement_counts: (k,) number of measurements in each point.
            seen_through_counts: (k,) number of scans that saw through each point.
        """
        # One integer identifies a grid cell: the cell number along x in the upper bits, along y in the lower ones.
        cell_numbers = np.floor(points / self.cell_m).astype(np.int64) @ np.array([1 << 31, 1])
        _, cell_indices = np.unique(cell_numbers, return_inverse=True)
        total_weights = np.bincount(cell_indices, weights)

        def compute_cell_means(values: Floats) -> Floats:
            return np.bincount(cell_indices, weights * values) / total_weights

        self.points_w = np.stack(
            [compute_cell_means(points[:, 0]), compute_cell_means(points[:, 1])], axis=1
        )
        mean_directions = np.stack(
            [
                compute_cell_means(outward_directions[:, 0]),
                compute_cell_means(outward_directions[:, 1]),
            ],
            axis=1,
        )
        length = np.maximum(np.hypot(mean_directions[:, 0], mean_directions[:, 1]), 1e-9)
        self.outward_directions_w = mean_directions / length[:, None]
        self.weights = np.minimum(total_weights, MAX_INFORMATION)
        self.measurement_counts = (
            np.bincount(cell_indices, measurement_counts) * self.weights / total_weights
        )

        touch_weights = np.bincount(cell_indices, np.where(normal_weights > 0, weights, 0.0))
        has_normal = touch_weights > MIN_TOUCH_RATIO * total_weights
        self.normal_weights = (
            np.minimum(np.bincount(cell_indices, normal_weights), MAX_NORMAL_INFORMATION)
            * has_normal
        )

        self.seen_through_counts = np.full(len(total_weights), np.inf)
        np.minimum.at(self.seen_through_counts, cell_indices, seen_through_counts)


def stack_surfaces(surfaces: list[SurfaceCells]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the cells of b surfaces as arrays, padded to the largest number of cells p.

    Args:
        surfaces: The surfaces of b obstacles, of which some may have no cells.

    Returns:
        Points (b, p, 2) in m, weights (b, p) in 1 / m², outward directions (b, p, 2), normal weights (b, p). Padding
        has the weight 0.
    """
    shape = (len(surfaces), max(len(surface) for surface in surfaces))
    points = np.zeros((*shape, 2))
    outward_directions = np.zeros((*shape, 2))
    weights = np.zeros(shape)
    normal_weights = np.zeros(shape)
    for row, surface in enumerate(surfaces):
        cell_count = len(surface)
        points[row, :cell_count] = surface.points_w
        points[row, cell_count:] = surface.points_w[0] if cell_count else 0.0
        outward_directions[row, :cell_count] = surface.outward_directions_w
        weights[row, :cell_count] = surface.weights / (
            1.0 + COMMON_VARIANCE_RATIO * surface.measurement_counts
        )
        normal_weights[row, :cell_count] = surface.normal_weights
    return points, weights, outward_directions, normal_weights

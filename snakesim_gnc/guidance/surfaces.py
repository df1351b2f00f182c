"""What is known of one obstacle's surface: points fused in cells, each an information filter of its own. Pure.

A cell holds the weighted mean of what was measured in it, and the weight is its information, 1 / m². A bounded number
of cells describes an obstacle of any size: when there are too many, they are made larger.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

CELL_M = 0.01
MAX_CELLS = 48
MAX_INFORMATION = 1.0 / 0.0015**2  # errors of pose and mount are common to all points, and do not average out
SPREAD = 0.05  # share of one measurement's variance that a cell's mean keeps, however many: it is but a slice of them
MAX_DOUBTS = 3  # times that a cell was looked through before it is dropped


def _none(*shape: int) -> Floats:
    return np.empty(shape)


@dataclass
class Surface:
    """Cells, in the world."""

    points_w: Floats = field(default_factory=lambda: _none(0, 2))
    weight: Floats = field(default_factory=lambda: _none(0))  # information, 1 / m²
    outward_w: Floats = field(default_factory=lambda: _none(0, 2))  # towards who saw it; of a touch, the normal
    normal_weight: Floats = field(default_factory=lambda: _none(0))  # information of that as a normal; 0: only seen
    count: Floats = field(default_factory=lambda: _none(0))  # measurements in it, as far as its weight counts them
    doubts: Floats = field(default_factory=lambda: _none(0))
    cell_m: float = CELL_M

    def __len__(self) -> int:
        return len(self.weight)

    def add(self, points_w: Floats, sd_m: Floats, outward_w: Floats, normal_weight: Floats | None = None) -> None:
        """Take in measured points (n, 2) with their sd (n,) and outward directions (n, 2)."""
        new = np.zeros(len(points_w)) if normal_weight is None else normal_weight
        points = np.vstack([self.points_w, points_w])
        weight = np.concatenate([self.weight, 1.0 / np.square(sd_m)])
        outward = np.vstack([self.outward_w, outward_w])
        normal = np.concatenate([self.normal_weight, new])
        count = np.concatenate([self.count, np.ones(len(new))])
        doubts = np.concatenate([self.doubts, np.zeros(len(new))])
        self._fuse(points, weight, outward, normal, count, doubts)
        while len(self) > MAX_CELLS:
            self.cell_m *= 1.5
            self._fuse(self.points_w, self.weight, self.outward_w, self.normal_weight, self.count, self.doubts)

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Drop the other cells."""
        if not kept.all():
            self.points_w, self.outward_w = self.points_w[kept], self.outward_w[kept]
            self.weight, self.normal_weight = self.weight[kept], self.normal_weight[kept]
            self.count, self.doubts = self.count[kept], self.doubts[kept]

    def drift(self, variance_m2: float) -> None:
        """The robot's own position has become less certain by this since the cells were measured."""
        self.weight = 1.0 / (1.0 / self.weight + variance_m2)

    def take(self, other: "Surface") -> None:
        """Merge another surface into this one."""
        self.add(other.points_w, 1.0 / np.sqrt(other.weight), other.outward_w, other.normal_weight)

    def _fuse(
        self, points: Floats, weight: Floats, outward: Floats, normal: Floats, count: Floats, doubts: Floats
    ) -> None:
        keys = np.floor(points / self.cell_m).astype(np.int64) @ np.array([1 << 31, 1])
        _, cell = np.unique(keys, return_inverse=True)
        total = np.bincount(cell, weight)

        def mean(values: Floats) -> Floats:
            return np.bincount(cell, weight * values) / total

        self.points_w = np.stack([mean(points[:, 0]), mean(points[:, 1])], axis=1)
        away = np.stack([mean(outward[:, 0]), mean(outward[:, 1])], axis=1)
        self.outward_w = away / np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)[:, None]
        self.weight = np.minimum(total, MAX_INFORMATION)
        self.count = np.bincount(cell, count) * self.weight / total
        felt = np.bincount(cell, np.where(normal > 0, weight, 0.0))
        self.normal_weight = np.minimum(np.bincount(cell, normal), 1e5) * (felt > 0.2 * total)
        fresh = np.full(len(total), np.inf)
        np.minimum.at(fresh, cell, doubts)
        self.doubts = fresh


def batched(surfaces: list[Surface]) -> tuple[Floats, Floats, Floats, Floats]:
    """Points (b, p, 2), weights (b, p), outward (b, p, 2), normal weights (b, p); weight 0 where there is no cell."""
    count, most = len(surfaces), max(len(s) for s in surfaces)
    points, outward = np.zeros((count, most, 2)), np.zeros((count, most, 2))
    weight, normal = np.zeros((count, most)), np.zeros((count, most))
    for i, surface in enumerate(surfaces):
        n = len(surface)
        points[i, :n], outward[i, :n] = surface.points_w, surface.outward_w
        points[i, n:] = surface.points_w[0] if n else 0.0
        weight[i, :n], normal[i, :n] = surface.weight / (1.0 + SPREAD * surface.count), surface.normal_weight
    return points, weight, outward, normal

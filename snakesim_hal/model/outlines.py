"""Obstacles and links as seen from above: their outlines, and distances to them. Pure geometry.

Every outline is a rounded box: points within `rounding_m` of a rectangle. A cylinder's rectangle is its center. Spheres
count with their radius.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Obstacle
from snakesim_hal.wire.quantities import above, bounded, from_zero

SHARES = (np.arange(5) + 0.5) / 5  # of a link: where it is held against obstacles
CORNERS = np.array([(1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1)], dtype=np.float64)


Coordinate = Annotated[float, bounded(-1000, 1000, "m")]
Size = Annotated[float, above(1000, "m")]
Clearance = Annotated[float, from_zero(100, "m")]
Friction = Annotated[float, from_zero(5, "1 (Coulomb coefficient)")]
Heading = Annotated[float, bounded(-6.3, 6.3, "rad")]
Point = tuple[Coordinate, Coordinate]


@dataclass(frozen=True)
class Outlines:
    """The outlines of many obstacles, for distances by the batch."""

    center_w: Floats  # (m, 2)
    turn: Floats  # (m, 2): cosine and sine of the rectangle's yaw
    half_m: Floats  # (m, 2): half its length and width
    rounding_m: Floats  # (m,)

    @classmethod
    def of(cls, obstacles: Sequence[Obstacle]) -> Self:
        """Of obstacles, in their order."""
        boxes = np.array([o.shape == "box" for o in obstacles], dtype=bool)
        yaw = np.array([o.yaw_rad for o in obstacles], dtype=np.float64)
        half = np.array([o.half_size_m[:2] for o in obstacles], dtype=np.float64).reshape(-1, 2)
        return cls(
            center_w=np.array([o.position_w[:2] for o in obstacles], dtype=np.float64).reshape(-1, 2),
            turn=np.column_stack([np.cos(yaw), np.sin(yaw)]),
            half_m=np.where(boxes[:, None], half, 0.0),
            rounding_m=np.where(boxes, 0.0, [o.radius_m for o in obstacles]),
        )

    @classmethod
    def of_segments(cls, from_w: Floats, to_w: Floats, rounding_m: float = 0.0) -> Self:
        """Of straight segments (m, 2) to (m, 2), as thick as twice the rounding."""
        run = to_w - from_w
        length = np.hypot(*run.T)
        ahead = np.where(length[:, None] > 0, run / np.maximum(length, 1e-12)[:, None], [1.0, 0.0])
        half = np.column_stack([0.5 * length, np.zeros_like(length)])
        return cls(0.5 * (from_w + to_w), ahead, half, np.full(len(run), rounding_m))

    def __len__(self) -> int:
        return len(self.center_w)

    @property
    def reach_m(self) -> Floats:
        """(m,): the farthest that an outline gets from its center."""
        return np.hypot(*self.half_m.T) + self.rounding_m

    @property
    def rims_w(self) -> Floats:
        """(m, 8, 2): corners and middles of the edges of the rectangles."""
        local = CORNERS * self.half_m[:, None, :]
        c, s = self.turn[:, None, 0], self.turn[:, None, 1]
        x, y = local[..., 0], local[..., 1]
        return self.center_w[:, None, :] + np.stack([c * x - s * y, s * x + c * y], axis=-1)

    def distance_m(self, points_w: Floats) -> Floats:
        """Distances from points (..., 2) to every outline, (..., m); negative inside."""
        x, y = self._local(points_w)
        over_x, over_y = np.abs(x) - self.half_m[:, 0], np.abs(y) - self.half_m[:, 1]
        outside = np.hypot(np.maximum(over_x, 0.0), np.maximum(over_y, 0.0))
        return outside + np.minimum(np.maximum(over_x, over_y), 0.0) - self.rounding_m

    def towards(self, points_w: Floats, which: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Distances (...) of points (..., 2) from the outline `which` (...) of each, and normals (..., 2) out of it."""
        c, s = self.turn[which, 0], self.turn[which, 1]
        dx, dy = points_w[..., 0] - self.center_w[which, 0], points_w[..., 1] - self.center_w[which, 1]
        local_x, local_y = c * dx + s * dy, c * dy - s * dx
        over_x, over_y = np.abs(local_x) - self.half_m[which, 0], np.abs(local_y) - self.half_m[which, 1]
        out_x, out_y = np.maximum(over_x, 0.0), np.maximum(over_y, 0.0)
        outside = np.hypot(out_x, out_y)
        distance = outside + np.minimum(np.maximum(over_x, over_y), 0.0) - self.rounding_m[which]
        free = outside > 0
        length = np.where(free, outside, 1.0)
        nx = np.where(free, out_x / length, over_x >= over_y) * np.where(local_x < 0, -1.0, 1.0)
        ny = np.where(free, out_y / length, over_x < over_y) * np.where(local_y < 0, -1.0, 1.0)
        return distance, np.stack([c * nx - s * ny, s * nx + c * ny], axis=-1)

    def _local(self, points_w: Floats) -> tuple[Floats, Floats]:
        offset_x = points_w[..., None, 0] - self.center_w[:, 0]
        offset_y = points_w[..., None, 1] - self.center_w[:, 1]
        c, s = self.turn[:, 0], self.turn[:, 1]
        return c * offset_x + s * offset_y, c * offset_y - s * offset_x


def gaps_m(one: Outlines, others: Outlines) -> Floats:
    """Gaps (m,) between one outline and each of the others; exact while they do not overlap."""
    from_one = others.distance_m(one.rims_w[0]).min(axis=0) - one.rounding_m[0]
    from_others = one.distance_m(others.rims_w)[..., 0].min(axis=1) - others.rounding_m
    return np.minimum(from_one, from_others)


def nearest_on_chain(nodes_w: Floats, outlines: Outlines) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Where a chain with nodes (n, 2) is nearest to each outline: which of `SHARES` of all links, point, distance."""
    rear, run = nodes_w[:-1, None], np.diff(nodes_w, axis=0)[:, None]
    points = (rear + SHARES[:, None] * run).reshape(-1, 2)
    distances = outlines.distance_m(points)
    best = distances.argmin(axis=0)
    return best, points[best], distances[best, np.arange(len(outlines))]


class Capsule(FileStruct, frozen=True, kw_only=True):
    """Outline of a link on the ground, from above."""

    name: str
    rear_m: tuple[float, float]
    front_m: tuple[float, float]
    radius_m: float


def outline_distance_m(obstacle: Obstacle, point: Floats) -> float:
    """Distance from a point on the ground to an obstacle's outline from above; negative inside."""
    offset = np.asarray(point, dtype=np.float64) - np.array(obstacle.position_w[:2])
    if obstacle.shape != "box":
        return float(np.hypot(*offset)) - obstacle.radius_m
    c, s = math.cos(obstacle.yaw_rad), math.sin(obstacle.yaw_rad)
    local = np.abs([c * offset[0] + s * offset[1], c * offset[1] - s * offset[0]])
    beyond = local - np.array(obstacle.half_size_m[:2])
    return float(np.hypot(*np.maximum(beyond, 0.0)) + min(float(beyond.max()), 0.0))

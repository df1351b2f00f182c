"""Outlines of obstacles and links as seen from above, and distances to them. Pure geometry.

Every outline is a rounded box: all points within `rounding_m` of a rectangle. The rectangle of a cylinder or a sphere
is a single point, its center, and its rounding is its radius.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_hal.wire.quantities import above, bounded, from_zero

# Positions along a link, as fractions of its length, at which its distance to obstacles is computed.
LINK_FRACTIONS = (np.arange(5) + 0.5) / 5

# Corners and edge middles of a rectangle, in units of its half length and half width.
UNIT_RIM_POINTS = np.array(
    [(1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1)], dtype=np.float64
)

ROUNDING_ERROR_M = 1e-6  # more than that of any distance in a scene
MIN_SEGMENT_M = 1e-12  # avoids a division by zero for a segment whose ends coincide

Coordinate = Annotated[float, bounded(-1000, 1000, "m")]
Size = Annotated[float, above(1000, "m")]
Clearance = Annotated[float, from_zero(100, "m")]
Friction = Annotated[float, from_zero(5, "1 (Coulomb coefficient)")]
Heading = Annotated[float, bounded(-6.3, 6.3, "rad")]
Point = tuple[Coordinate, Coordinate]


@dataclass(frozen=True)
class ObstacleOutlines:
    """The outlines of m obstacles as arrays, so that distances to all of them are computed at once."""

    center_w: Floats  # (m, 2), m
    direction: Floats  # (m, 2): cosine and sine of the rectangle's yaw
    half_m: Floats  # (m, 2): half of the rectangle's length and width
    rounding_m: Floats  # (m,)

    @classmethod
    def from_obstacles(cls, obstacles: Sequence[KnownObstacle]) -> Self:
        """Return the outlines of obstacles, in their order."""
        is_box = np.array([obstacle.shape == "box" for obstacle in obstacles], dtype=bool)
        center_w = np.array([obstacle.position_w[:2] for obstacle in obstacles], dtype=np.float64)
        yaw_rad = np.array([obstacle.yaw_rad for obstacle in obstacles], dtype=np.float64)
        half_m = np.array([obstacle.half_size_m[:2] for obstacle in obstacles], dtype=np.float64)
        radius_m = [obstacle.radius_m for obstacle in obstacles]
        return cls(
            center_w=center_w.reshape(-1, 2),
            direction=np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)]),
            half_m=np.where(is_box[:, None], half_m.reshape(-1, 2), 0.0),
            rounding_m=np.where(is_box, 0.0, radius_m),
        )

    @classmethod
    def from_segments(cls, from_w: Floats, to_w: Floats, rounding_m: float = 0.0) -> Self:
        """Return the outlines of straight segments, which may be rounded.

        Args:
            from_w: First end of every segment, (m, 2), m.
            to_w: Second end of every segment, (m, 2), m.
            rounding_m: Half of the thickness of every segment.
        """
        segments_w = to_w - from_w  # (m, 2)
        length_m = np.hypot(*segments_w.T)
        # A segment whose ends coincide has no direction; any one does.
        direction = segments_w / np.maximum(length_m, MIN_SEGMENT_M)[:, None]
        direction = np.where(length_m[:, None] > 0, direction, [1.0, 0.0])
        # A segment is a rectangle without width.
        half_m = np.column_stack([0.5 * length_m, np.zeros_like(length_m)])
        return cls(
            center_w=0.5 * (from_w + to_w),
            direction=direction,
            half_m=half_m,
            rounding_m=np.full(len(segments_w), rounding_m),
        )

    def __len__(self) -> int:
        return len(self.center_w)

    def select(self, indices: NDArray[np.intp]) -> "ObstacleOutlines":
        """Return the outlines with these indices."""
        return ObstacleOutlines(
            self.center_w[indices],
            self.direction[indices],
            self.half_m[indices],
            self.rounding_m[indices],
        )

    def append(self, others: "ObstacleOutlines") -> "ObstacleOutlines":
        """Return these outlines and others after them."""
        return ObstacleOutlines(
            np.concatenate((self.center_w, others.center_w)),
            np.concatenate((self.direction, others.direction)),
            np.concatenate((self.half_m, others.half_m)),
            np.concatenate((self.rounding_m, others.rounding_m)),
        )

    @cached_property
    def bounding_radius_m(self) -> Floats:
        """Return the distance from each center to the farthest point of its outline, (m,)."""
        return np.hypot(*self.half_m.T) + self.rounding_m

    @property
    def rims_w(self) -> Floats:
        """Return the corners and edge middles of the rectangles in the world, (m, 8, 2)."""
        local = UNIT_RIM_POINTS * self.half_m[:, None, :]
        x = local[..., 0]
        y = local[..., 1]
        cosine = self.direction[:, None, 0]
        sine = self.direction[:, None, 1]
        rotated = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        return self.center_w[:, None, :] + rotated

    def compute_distances_m(self, points_w: Floats) -> Floats:
        """Compute the distances in m from points (..., 2) to every outline, (..., m); negative inside.

        With q = |p| - h, where p is the point in the rectangle's frame and h its half size, the distance is
        |max(q, 0)| + min(max(q_x, q_y), 0) - rounding.
        """
        local_x, local_y = self._transform_to_local_frames(points_w)
        # How far a point is beyond the edges of the rectangle in x and in y; negative within them.
        over_x = np.abs(local_x) - self.half_m[:, 0]
        over_y = np.abs(local_y) - self.half_m[:, 1]
        # One of these two is 0: the distance outside of the rectangle, and minus the depth inside of it.
        outside_m = np.hypot(np.maximum(over_x, 0.0), np.maximum(over_y, 0.0))
        inside_m = np.minimum(np.maximum(over_x, over_y), 0.0)
        return outside_m + inside_m - self.rounding_m

    def compute_distances_and_normals(
        self, points_w: Floats, outline_indices: NDArray[np.intp]
    ) -> tuple[Floats, Floats]:
        """Compute the distance of each point from an outline of its own, and the outward normal there.

        An outline is a rectangle, made larger on all sides by `rounding_m`; see `compute_distances_m` for the equation.
        Outside of the rectangle, the normal points away from the nearest point of the rectangle. Inside, it points out
        of the nearest edge. The rounding does not change it.

        Args:
            points_w: Points in the world, (..., 2), m.
            outline_indices: Index of an outline for each point, (...).

        Returns:
            Distances in m, (...), negative inside, and unit normals in the world, (..., 2).
        """
        # All arrays below are (...), one number for each point.
        # The point in the frame of its rectangle.
        cosine = self.direction[outline_indices, 0]
        sine = self.direction[outline_indices, 1]
        dx = points_w[..., 0] - self.center_w[outline_indices, 0]
        dy = points_w[..., 1] - self.center_w[outline_indices, 1]
        local_x = cosine * dx + sine * dy
        local_y = cosine * dy - sine * dx

        # How far the point is beyond the edges of the rectangle in x and in y, in m; negative within them.
        over_x = np.abs(local_x) - self.half_m[outline_indices, 0]
        over_y = np.abs(local_y) - self.half_m[outline_indices, 1]
        outside_x = np.maximum(over_x, 0.0)
        outside_y = np.maximum(over_y, 0.0)
        outside_distance = np.hypot(outside_x, outside_y)
        distance = (
            outside_distance
            + np.minimum(np.maximum(over_x, over_y), 0.0)
            - self.rounding_m[outline_indices]
        )

        # The normal in the quadrant of the rectangle's frame in which x and y are positive.
        is_outside = outside_distance > 0
        divisor = np.where(is_outside, outside_distance, 1.0)  # no division by zero inside
        inside_normal_x = np.where(over_x >= over_y, 1.0, 0.0)
        inside_normal_y = np.where(over_x < over_y, 1.0, 0.0)
        normal_x = np.where(is_outside, outside_x / divisor, inside_normal_x)
        normal_y = np.where(is_outside, outside_y / divisor, inside_normal_y)

        # The normal in the quadrant of the point, and then in the world.
        normal_x = normal_x * np.where(local_x < 0, -1.0, 1.0)
        normal_y = normal_y * np.where(local_y < 0, -1.0, 1.0)
        normal_w = np.stack(
            [cosine * normal_x - sine * normal_y, sine * normal_x + cosine * normal_y], axis=-1
        )
        return distance, normal_w

    def _transform_to_local_frames(self, points_w: Floats) -> tuple[Floats, Floats]:
        """Return x and y of points (..., 2) in the frame of every rectangle, each (..., m)."""
        offset_x = points_w[..., None, 0] - self.center_w[:, 0]
        offset_y = points_w[..., None, 1] - self.center_w[:, 1]
        cosine = self.direction[:, 0]
        sine = self.direction[:, 1]
        local_x = cosine * offset_x + sine * offset_y
        local_y = cosine * offset_y - sine * offset_x
        return local_x, local_y


def compute_gaps_m(single: ObstacleOutlines, others: ObstacleOutlines) -> Floats:
    """Return the gaps (m,) between a single outline and each of the others; exact while they do not overlap."""
    from_single = others.compute_distances_m(single.rims_w[0]).min(axis=0) - single.rounding_m[0]
    from_others = single.compute_distances_m(others.rims_w)[..., 0].min(axis=1) - others.rounding_m
    return np.minimum(from_single, from_others)


def has_gap_below(single: ObstacleOutlines, others: ObstacleOutlines, limit_m: float) -> bool:
    """Return whether any gap that `compute_gaps_m` would return is below a limit.

    Most of the others are so far away that the circles around both show it, which is faster.
    """
    offset_w = others.center_w - single.center_w
    distances_m = np.hypot(offset_w[:, 0], offset_w[:, 1])
    min_gaps_m = distances_m - others.bounding_radius_m - single.bounding_radius_m
    near = np.flatnonzero(min_gaps_m < limit_m + ROUNDING_ERROR_M)
    if not len(near):
        return False
    return bool(compute_gaps_m(single, others.select(near)).min() < limit_m)


class NearestChainPoints(NamedTuple):
    """The point of a chain that is nearest to each of m outlines."""

    point_index: NDArray[np.intp]  # (m,), among all `LINK_FRACTIONS` of all links, tail to head
    point_w: Floats  # (m, 2), m
    distance_m: Floats  # (m,), negative inside the outline


def find_nearest_points_on_chain(nodes_w: Floats, outlines: ObstacleOutlines) -> NearestChainPoints:
    """Find the point of a chain that is nearest to each outline, among `LINK_FRACTIONS` of every link.

    Args:
        nodes_w: Tail end, joints and head end of the chain, (n, 2), m.
        outlines: Outlines of m obstacles.
    """
    # Points on all links, (n - 1, fractions, 2) and then in one row, (points, 2).
    rear_ends_w = nodes_w[:-1, None]
    links_w = np.diff(nodes_w, axis=0)[:, None]
    points_on_links_w = rear_ends_w + LINK_FRACTIONS[:, None] * links_w
    points_w = points_on_links_w.reshape(-1, 2)

    distances_m = outlines.compute_distances_m(points_w)  # (points, m)
    nearest = distances_m.argmin(axis=0)
    nearest_distances_m = distances_m[nearest, np.arange(len(outlines))]
    return NearestChainPoints(nearest, points_w[nearest], nearest_distances_m)


class CapsuleOutline(FileStruct, frozen=True, kw_only=True):
    """Outline of a link on the ground, from above."""

    name: str
    rear_m: tuple[float, float]  # center of the rear cap
    front_m: tuple[float, float]  # center of the front cap
    radius_m: float


def compute_outline_distance_m(obstacle: KnownObstacle, point: Floats) -> float:
    """Return the distance from a point on the ground to an obstacle's outline from above; negative inside."""
    offset = np.asarray(point, dtype=np.float64) - np.array(obstacle.position_w[:2])
    if obstacle.shape != "box":
        return float(np.hypot(*offset)) - obstacle.radius_m
    cosine = math.cos(obstacle.yaw_rad)
    sine = math.sin(obstacle.yaw_rad)
    local_x = cosine * offset[0] + sine * offset[1]
    local_y = cosine * offset[1] - sine * offset[0]
    beyond = np.abs([local_x, local_y]) - np.array(obstacle.half_size_m[:2])
    outside = np.hypot(*np.maximum(beyond, 0.0))
    inside = min(float(beyond.max()), 0.0)
    return float(outside + inside)

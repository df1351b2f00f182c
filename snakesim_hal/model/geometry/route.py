"""A route on the ground, which is a planar curve by arc length, and how a chain lies on it. Pure geometry."""

import itertools
import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

HEADING_WINDOW_M = 0.005  # half of the length over which a heading is averaged
MIN_BEND_RAD = 1e-9  # a smaller change of direction between two segments is a rounding error
MAX_CHORD_ITERATIONS = 20
CHORD_TOLERANCE_M = 1e-7


def is_polyline(points_w: Floats) -> bool:
    """Return whether (n, 2) points are a line: at least two, and no two neighbors coincide."""
    if len(points_w) < 2:
        return False
    differs = points_w[1:] != points_w[:-1]  # (n - 1, 2)
    differs_in_x, differs_in_y = differs.T
    return bool((differs_in_x | differs_in_y).all())


class Route:
    """A planar curve that dense points describe, parametrized by arc length; straight beyond both ends."""

    def __init__(self, points_w: Floats | Sequence[tuple[float, float]]) -> None:
        """Compute the arc length of every point, and the direction of every segment.

        Args:
            points_w: Points of the route in the direction of travel, (n, 2), m.

        Raises:
            ValueError: There are fewer than two points, or two neighbors coincide.
        """
        self.points_w = np.ascontiguousarray(points_w, dtype=np.float64)
        if not is_polyline(self.points_w):
            raise ValueError("a route needs at least two points, and no two neighbors may coincide")
        segments = np.diff(self.points_w, axis=0)
        segment_lengths_m = np.hypot(segments[:, 0], segments[:, 1])
        self._arc_lengths_m = np.concatenate(([0.0], np.cumsum(segment_lengths_m)))  # (n,), m

        # Unit vectors.
        self._first_direction = segments[0] / segment_lengths_m[0]
        self._last_direction = segments[-1] / segment_lengths_m[-1]
        self._segment_directions = segments / segment_lengths_m[:, None]  # (n - 1, 2)

        # Bounds of the distance along each segment, (n - 1,): the first and the last segment are extended to infinity.
        self._min_along_m = np.zeros(len(segments))
        self._max_along_m = np.diff(self._arc_lengths_m)
        self._min_along_m[0] = -np.inf
        self._max_along_m[-1] = np.inf

        # The same as lists, for `compute_point`: Python floats are faster for a single point.
        self._arc_length_list: list[float] = self._arc_lengths_m.tolist()
        self._segment_start_list: list[tuple[float, float]] = [
            (x, y) for x, y in self.points_w.tolist()
        ]
        self._segment_direction_list: list[tuple[float, float]] = [
            (x, y) for x, y in self._segment_directions.tolist()
        ]

    @property
    def length_m(self) -> float:
        """Return the arc length from the first to the last point."""
        return float(self._arc_lengths_m[-1])

    def compute_positions_w(self, s_m: Floats | float) -> Floats:
        """Return the points at arc lengths `s_m`, shape (..., 2)."""
        s = np.asarray(s_m, dtype=np.float64)
        x = np.interp(s, self._arc_lengths_m, self.points_w[:, 0])
        y = np.interp(s, self._arc_lengths_m, self.points_w[:, 1])
        points = np.stack([x, y], axis=-1)
        before = np.minimum(s, 0.0)[..., None] * self._first_direction
        beyond = np.maximum(s - self.length_m, 0.0)[..., None] * self._last_direction
        return points + before + beyond

    def compute_point(self, s_m: float) -> tuple[float, float]:
        """Return the point at arc length `s_m`; like `position_w`, and much faster for a single point."""
        last = len(self._segment_direction_list) - 1
        segment = min(max(bisect_right(self._arc_length_list, s_m) - 1, 0), last)
        along = s_m - self._arc_length_list[segment]
        x, y = self._segment_start_list[segment]
        dx, dy = self._segment_direction_list[segment]
        return x + along * dx, y + along * dy

    def compute_heading_rad(self, s_m: float) -> float:
        """Return the direction of travel at arc length `s_m`, averaged over 10 mm."""
        x0, y0 = self.compute_point(s_m - HEADING_WINDOW_M)
        x1, y1 = self.compute_point(s_m + HEADING_WINDOW_M)
        return math.atan2(y1 - y0, x1 - x0)

    def tangent_w(self, s_m: float) -> Floats:
        """Return the unit vector of travel at arc length `s_m`, shape (2,)."""
        heading = self.compute_heading_rad(s_m)
        return np.array([np.cos(heading), np.sin(heading)])

    def project_point(
        self, point_w: Floats, near_s_m: float | None = None, window_m: float = 0.5
    ) -> float:
        """Return the arc length of the route's point that is nearest to a point.

        Args:
            point_w: Point in the world, (2,), m.
            near_s_m: Arc length around which to search. None searches the whole route.
            window_m: Length of the searched part to either side of `near_s_m`.

        Returns:
            Arc length in m. It is negative before the route's start, and more than its length beyond its end.
        """
        first, end = self._find_segments_near(near_s_m, window_m)
        starts = self.points_w[first:end]
        directions = self._segment_directions[first:end]

        # Distance along each segment to the foot of the perpendicular, limited to the segment.
        along_m = np.einsum("ij,ij->i", point_w - starts, directions)
        along_m = np.maximum(along_m, self._min_along_m[first:end])
        along_m = np.minimum(along_m, self._max_along_m[first:end])

        offsets = starts + along_m[:, None] * directions - point_w
        squared_distances = np.einsum("ij,ij->i", offsets, offsets)
        nearest = int(squared_distances.argmin())
        return float(self._arc_lengths_m[first + nearest] + along_m[nearest])

    def _find_segments_near(self, near_s_m: float | None, window_m: float) -> tuple[int, int]:
        """Return the first segment of a window and the one after its last; of the whole route without a window."""
        count = len(self._arc_lengths_m) - 1
        if near_s_m is None:
            return 0, count
        first = max(bisect_left(self._arc_length_list, near_s_m - window_m) - 1, 0)
        last = min(bisect_left(self._arc_length_list, near_s_m + window_m) + 1, count)
        first = min(first, count - 1)
        last = max(last, first + 1)
        return first, last

    def find_inflections_s_m(self) -> list[float]:
        """Return the arc lengths at which the curvature changes sign, strictly inside the route."""
        heading = np.unwrap(
            np.arctan2(self._segment_directions[:, 1], self._segment_directions[:, 0])
        )
        bend = np.diff(heading)
        bent_joints = np.flatnonzero(np.abs(bend) > MIN_BEND_RAD)
        inflections: list[float] = []
        for before, after in itertools.pairwise(bent_joints):
            if bend[before] * bend[after] < 0:
                middle = 0.5 * (self._arc_lengths_m[before + 1] + self._arc_lengths_m[after + 1])
                inflections.append(float(middle))
        return inflections


def sample_sine_curve(
    amplitude_m: float, wavelength_m: float, length_m: float, spacing_m: float = 0.01
) -> Floats:
    """Return points of y = A sin(2 pi x / lambda) for x in [0, length_m], shape (n, 2).

    Args:
        amplitude_m: Amplitude A.
        wavelength_m: Wavelength lambda.
        length_m: Length of the curve along x.
        spacing_m: Maximum distance along x between two points.
    """
    count = max(int(np.ceil(length_m / spacing_m)), 1) + 1
    x = np.linspace(0.0, length_m, count)
    return np.column_stack([x, amplitude_m * np.sin(2 * np.pi * x / wavelength_m)])


def find_arc_length_at_distance(
    route: Route, from_w: tuple[float, float], from_s_m: float, distance_m: float
) -> float:
    """Return the arc length of the next point of a route that is at a straight distance from a point on the route.

    The fixed-point iteration moves along the route by the straight distance that is still missing.

    Args:
        route: Route.
        from_w: Point on the route, m.
        from_s_m: Arc length of `from_w`. The result is larger.
        distance_m: Straight distance between `from_w` and the point that is searched for.
    """
    from_x, from_y = from_w
    s = from_s_m + distance_m
    for _ in range(MAX_CHORD_ITERATIONS):
        x, y = route.compute_point(s)
        error = distance_m - math.hypot(x - from_x, y - from_y)
        s += error
        if abs(error) < CHORD_TOLERANCE_M:
            break
    return s


@dataclass(frozen=True)
class ChainOnRoute:
    """The pose of a chain of straight segments with every joint on a route."""

    tail_w: tuple[float, float]  # m
    heading_rad: float  # of the first segment
    angles_rad: Floats  # (n_segments - 1,), tail to head, left turn positive


def place_chain_on_route(
    route: Route, tail_s_m: float, segment_lengths_m: Sequence[float]
) -> ChainOnRoute:
    """Place a chain of straight segments on a route, with its tail end and every joint on the curve.

    Args:
        route: Route.
        tail_s_m: Arc length of the tail end.
        segment_lengths_m: Length of every segment, tail to head.
    """
    s = tail_s_m
    tail_w = route.compute_point(s)
    rear_x, rear_y = tail_w
    headings_rad: list[float] = []
    for length_m in segment_lengths_m:
        s = find_arc_length_at_distance(route, (rear_x, rear_y), s, length_m)
        front_x, front_y = route.compute_point(s)
        headings_rad.append(math.atan2(front_y - rear_y, front_x - rear_x))
        rear_x, rear_y = front_x, front_y
    angles_rad = (np.diff(headings_rad) + np.pi) % (2 * np.pi) - np.pi  # from -pi to pi
    return ChainOnRoute(tail_w, headings_rad[0], angles_rad)


def compute_yaw_segments_m(axes: Sequence[str], link_lengths_m: Sequence[float]) -> list[float]:
    """Return the lengths of the straight segments between yaw joints, tail to head.

    Args:
        axes: Axis of every joint, tail to head.
        link_lengths_m: Length of every link, tail to head. There is one link more than joints.
    """
    segments_m = [link_lengths_m[0]]
    for axis, length_m in zip(axes, link_lengths_m[1:], strict=True):
        if axis == "yaw":
            segments_m.append(length_m)
        else:
            segments_m[-1] += length_m
    return segments_m


def expand_yaw_angles(axes: Sequence[str], yaw_angles_rad: Floats) -> Floats:
    """Return the angles of all joints, (n_joints,): the yaw joints with their angles, every other joint straight."""
    yaw_joints = [i for i, axis in enumerate(axes) if axis == "yaw"]
    angles_rad = np.zeros(len(axes))
    angles_rad[yaw_joints] = yaw_angles_rad
    return angles_rad

"""A route on the ground: a smooth planar curve by arc length, and how a chain lies on it. Pure geometry."""

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats


def is_line(points_w: Floats) -> bool:
    """Whether (n, 2) points make a line: two at least, and no two neighbors coincide."""
    return len(points_w) >= 2 and bool((points_w[1:] != points_w[:-1]).any(axis=1).all())


class Route:
    """A planar curve given by dense points, parametrised by arc length; straight beyond both ends.

    points_w: (n, 2) float64, metres, in the direction of travel.
    """

    def __init__(self, points_w: Floats | Sequence[tuple[float, float]]) -> None:
        self.points_w = np.ascontiguousarray(points_w, dtype=np.float64)
        if not is_line(self.points_w):
            raise ValueError("a route needs at least two points, and no two neighbors may coincide")
        steps = np.diff(self.points_w, axis=0)
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        self._s = np.concatenate(([0.0], np.cumsum(lengths)))
        self._first_direction = steps[0] / lengths[0]
        self._last_direction = steps[-1] / lengths[-1]
        self._segment_direction = steps / lengths[:, None]
        self._s_list: list[float] = self._s.tolist()
        self._start_list: list[tuple[float, float]] = [(x, y) for x, y in self.points_w.tolist()]
        self._direction_list: list[tuple[float, float]] = [(x, y) for x, y in self._segment_direction.tolist()]

    @property
    def length_m(self) -> float:
        """Arc length from first to last point."""
        return float(self._s[-1])

    def position_w(self, s_m: Floats | float) -> Floats:
        """Points at arc lengths `s_m`, shape (..., 2)."""
        s = np.asarray(s_m, dtype=np.float64)
        points = np.stack(
            [np.interp(s, self._s, self.points_w[:, 0]), np.interp(s, self._s, self.points_w[:, 1])], axis=-1
        )
        before = np.minimum(s, 0.0)[..., None] * self._first_direction
        beyond = np.maximum(s - self.length_m, 0.0)[..., None] * self._last_direction
        return points + before + beyond

    def at(self, s_m: float) -> tuple[float, float]:
        """The point at arc length `s_m`; like `position_w`, and much faster for a single point."""
        i = min(max(bisect_right(self._s_list, s_m) - 1, 0), len(self._direction_list) - 1)
        beyond = s_m - self._s_list[i]
        (x, y), (dx, dy) = self._start_list[i], self._direction_list[i]
        return x + beyond * dx, y + beyond * dy

    def heading_rad(self, s_m: float) -> float:
        """Direction of travel at arc length `s_m`, averaged over 10 mm."""
        (x0, y0), (x1, y1) = self.at(s_m - 0.005), self.at(s_m + 0.005)
        return math.atan2(y1 - y0, x1 - x0)

    def tangent_w(self, s_m: float) -> Floats:
        """Unit vector of travel at arc length `s_m`, shape (2,)."""
        heading = self.heading_rad(s_m)
        return np.array([np.cos(heading), np.sin(heading)])

    def project(self, point_w: Floats, near_s_m: float | None = None, window_m: float = 0.5) -> float:
        """Arc length of the route's point nearest to `point_w`; with `near_s_m`, only within the window around it."""
        starts = self.points_w[:-1]
        first, last = 0, len(starts)
        if near_s_m is not None:
            first = max(int(np.searchsorted(self._s, near_s_m - window_m)) - 1, 0)
            last = min(int(np.searchsorted(self._s, near_s_m + window_m)) + 1, len(starts))
            first = min(first, len(starts) - 1)
            last = max(last, first + 1)
        directions = self._segment_direction[first:last]
        along = np.einsum("ij,ij->i", point_w - starts[first:last], directions)
        lengths = np.diff(self._s[first : last + 1])
        low = np.zeros_like(lengths)
        high = lengths.copy()
        if first == 0:
            low[0] = -np.inf
        if last == len(starts):
            high[-1] = np.inf
        along = np.clip(along, low, high)
        gaps = starts[first:last] + along[:, None] * directions - point_w
        best = int(np.argmin(np.einsum("ij,ij->i", gaps, gaps)))
        return float(self._s[first + best] + along[best])

    def inflections_s_m(self) -> list[float]:
        """Arc lengths at which the curvature changes sign, strictly inside the route."""
        heading = np.unwrap(np.arctan2(self._segment_direction[:, 1], self._segment_direction[:, 0]))
        bend = np.diff(heading)
        moving = np.flatnonzero(np.abs(bend) > 1e-9)
        flips = [(a, b) for a, b in itertools.pairwise(moving) if bend[a] * bend[b] < 0]
        return [float(0.5 * (self._s[a + 1] + self._s[b + 1])) for a, b in flips]


def sine_points(amplitude_m: float, wavelength_m: float, length_m: float, spacing_m: float = 0.01) -> Floats:
    """Points of y = A sin(2 pi x / lambda) for x in [0, length_m], shape (n, 2)."""
    count = max(int(np.ceil(length_m / spacing_m)), 1) + 1
    x = np.linspace(0.0, length_m, count)
    return np.column_stack([x, amplitude_m * np.sin(2 * np.pi * x / wavelength_m)])


def next_on_route(route: Route, from_w: tuple[float, float], from_s_m: float, distance_m: float) -> float:
    """Arc length beyond `from_s_m` of the route's point at straight distance `distance_m` from `from_w`."""
    s = from_s_m + distance_m
    for _ in range(20):
        x, y = route.at(s)
        error = distance_m - math.hypot(x - from_w[0], y - from_w[1])
        s += error
        if abs(error) < 1e-7:
            break
    return s


@dataclass(frozen=True)
class ChainOnRoute:
    """The pose of a chain of straight segments with every joint on a route."""

    tail_w: tuple[float, float]
    heading_rad: float  # of the first segment
    angles_rad: Floats  # (n_segments - 1,), tail to head, left turn positive


def lay_chain(route: Route, tail_s_m: float, segment_lengths_m: Sequence[float]) -> ChainOnRoute:
    """Lay straight segments, tail to head, with the tail end at `tail_s_m` and every joint on the route."""
    s = tail_s_m
    tail = point = route.at(s)
    headings: list[float] = []
    for length in segment_lengths_m:
        s = next_on_route(route, point, s, length)
        ahead = route.at(s)
        headings.append(math.atan2(ahead[1] - point[1], ahead[0] - point[0]))
        point = ahead
    turns = np.diff(headings)
    return ChainOnRoute(tail, headings[0], (turns + np.pi) % (2 * np.pi) - np.pi)


def yaw_segments_m(axes: Sequence[str], link_lengths_m: Sequence[float]) -> list[float]:
    """Lengths of the straight segments between yaw joints.

    axes: n joints, tail to head; link_lengths_m: n + 1 links.
    """
    segments = [link_lengths_m[0]]
    for axis, length in zip(axes, link_lengths_m[1:], strict=True):
        if axis == "yaw":
            segments.append(length)
        else:
            segments[-1] += length
    return segments


def chain_angles(axes: Sequence[str], yaw_angles_rad: Floats) -> Floats:
    """Angles of all joints, (n_joints,): the yaw joints as given, every other joint straight."""
    angles = np.zeros(len(axes))
    angles[[i for i, axis in enumerate(axes) if axis == "yaw"]] = yaw_angles_rad
    return angles

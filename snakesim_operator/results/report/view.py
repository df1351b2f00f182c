"""Computes viewports of top views: the drawn window of the ground, and the scales of length and force."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.page.svg import Point
from snakesim_operator.results.report.snapshots import RunSnapshot
from snakesim_operator.results.run_log import RunRecord

MAX_ARROW_LENGTH = 72.0  # length of the arrow of the strongest force, in units of the drawing
# Over MAX_ARROW_LENGTH: a longer arrow is cut, so that one impact does not dwarf other forces.
MAX_MEASURED_ARROW_RATIO = 1.1
MARGIN = 22.0
ARROW_MARGIN = 80.0  # around the body, with room for arrows, in units of the drawing
MAX_HEIGHT_RATIO = 1.1  # height over width
# Of the window: a larger obstacle, such as a wall, is cut at the edge.
MAX_WHOLE_OBSTACLE_FRACTION = 0.5
MAX_GROWTH_STEPS = 4  # to enlarge a window around the obstacles that it cuts
FOOTER_HEIGHT = 30.0  # height of the area below the map with the scale bars


@dataclass(frozen=True)
class MapViewport:
    """A window of the ground, with a scale for length and one for force. All snapshots of a report share the scales."""

    min_corner_w: Floats  # (2,), lower left corner in m, in the rotated frame
    pixels_per_m: float
    pixels_per_n: float
    width: float
    height: float
    is_rotated: bool  # the ground is drawn rotated by a quarter turn, because the body lies along y

    def rotate(self, vectors_w: Floats) -> Floats:
        """Rotate world vectors (..., 2) into the frame of the drawing, with y still up."""
        if not self.is_rotated:
            return vectors_w
        return np.stack([vectors_w[..., 1], -vectors_w[..., 0]], axis=-1)

    def to_pixels(self, point_w: Floats | tuple[float, ...]) -> Point:
        """Convert a point of the ground, in m, to coordinates of the drawing."""
        x, y = (
            self.rotate(np.asarray(point_w, dtype=np.float64)[:2]) - self.min_corner_w
        ) * self.pixels_per_m
        return float(x), float(self.height - FOOTER_HEIGHT - y)

    def offset_pixels(
        self, start: Point, vector_w: Floats | tuple[float, ...], units: float
    ) -> Point:
        """Offset a point of the drawing by a world vector times `units`."""
        x, y = self.rotate(np.asarray(vector_w, dtype=np.float64)[:2])
        return float(start[0] + units * x), float(start[1] - units * y)

    def is_drawn(self, obstacle: KnownObstacle) -> bool:
        """Return whether an obstacle is drawn: only if it fits completely, unless it is too large for the window."""
        x, y = self.to_pixels(obstacle.position_w)
        half_extent = self.pixels_per_m * find_half_extent_m(obstacle)
        map_width = self.width
        map_height = self.height - FOOTER_HEIGHT
        if half_extent > MAX_WHOLE_OBSTACLE_FRACTION * min(map_width, map_height):
            return (
                -half_extent < x < map_width + half_extent
                and -half_extent < y < map_height + half_extent
            )
        return (
            half_extent <= x <= map_width - half_extent
            and half_extent <= y <= map_height - half_extent
        )


def find_half_extent_m(obstacle: KnownObstacle) -> float:
    """Return how far an obstacle extends from its center on the ground, in m."""
    return max(obstacle.radius_m, math.hypot(*obstacle.half_size_m[:2]))


def compute_viewports(
    record: RunRecord, snapshots: list[RunSnapshot], width: float
) -> list[MapViewport]:
    """Compute a viewport around the body for each snapshot, all of one size and one scale, with room for arrows."""
    if not snapshots:
        return []
    bodies = [find_body_points_xy_w(record, snapshot.row) for snapshot in snapshots]
    max_force_n = _max_force_n(snapshots)
    pixels_per_n = MAX_ARROW_LENGTH / max_force_n if max_force_n > 0 else 0.0
    return _fit_viewports(record, bodies, pixels_per_n, width)


def _max_force_n(snapshots: list[RunSnapshot]) -> float:
    """Return the largest desired force in N; without any, the largest measured force."""
    desired_n: list[float] = []
    measured_n: list[float] = []
    for snapshot in snapshots:
        if snapshot.force_balance is not None:
            desired_n += [
                *snapshot.force_balance.magnitudes_n,
                float(np.hypot(*snapshot.force_balance.resultant_force_n)),
            ]
        measured_n += [math.hypot(*contact.force_w[:2]) for contact in snapshot.measured_contacts]
    return max(desired_n or measured_n, default=0.0)


def compute_map_viewport(
    record: RunRecord, body_points_w: list[Floats], pixels_per_n: float, width: float
) -> MapViewport:
    """Compute one viewport for a whole run.

    Args:
        record: The recorded run.
        body_points_w: (k, 2) body points at each of some times, in m.
        pixels_per_n: Scale of force, in units of the drawing per newton.
        width: Width of the drawing.
    """
    return _fit_viewports(record, [np.vstack(body_points_w)], pixels_per_n, width)[0]


def _fit_viewports(
    record: RunRecord, point_sets: list[Floats], pixels_per_n: float, width: float
) -> list[MapViewport]:
    """Fit a viewport around each set of points, all of one size and one scale.

    If the first set is taller than wide, the ground is rotated by a quarter turn. A window grows so that it does not
    cut obstacles.

    Args:
        record: The recorded run, with its obstacles.
        point_sets: Points in the world to show, (k, 2) in m.
        pixels_per_n: Scale of force, in units of the drawing per newton.
        width: Width of the drawings.
    """
    span_x, span_y = np.ptp(point_sets[0], axis=0)
    upright = bool(span_y > 1.3 * span_x)
    unscaled = MapViewport(np.zeros(2), 1.0, pixels_per_n, 0.0, 0.0, upright)
    rotated_sets = [unscaled.rotate(points) for points in point_sets]
    max_span_m = max(float(np.ptp(points[:, 0])) for points in rotated_sets)
    margin_m = ARROW_MARGIN * max_span_m / (width - 2 * ARROW_MARGIN)

    window_corners: list[tuple[Floats, Floats]] = []
    for points in rotated_sets:
        low = points.min(axis=0) - margin_m
        high = points.max(axis=0) + margin_m
        window_corners.append(_grow_around_obstacles(record, unscaled, low, high))

    # The largest window sets the scale of all.
    width_m, height_m = np.max([high - low for low, high in window_corners], axis=0)
    scale = width / float(width_m)
    height = min(float(height_m) * scale, MAX_HEIGHT_RATIO * width)
    half_size_m = np.array([width, height]) / (2 * scale)
    viewports: list[MapViewport] = []
    for low, high in window_corners:
        corner = (low + high) / 2 - half_size_m
        viewports.append(
            MapViewport(corner, scale, pixels_per_n, width, height + FOOTER_HEIGHT, upright)
        )
    return viewports


def _grow_around_obstacles(
    record: RunRecord, unscaled: MapViewport, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    """Enlarge a window, given by its corners, until it cuts no obstacle except large ones."""
    max_half_extent_m = MAX_WHOLE_OBSTACLE_FRACTION * float((high - low).min())
    small: list[tuple[Floats, float]] = []
    for item in record.placed_obstacles:
        half_extent_m = find_half_extent_m(item.obstacle)
        if half_extent_m <= max_half_extent_m:
            small.append(
                (unscaled.rotate(np.array(item.obstacle.position_w[:2])), 1.1 * half_extent_m)
            )
    for _ in range(MAX_GROWTH_STEPS):
        cut = [
            (at, half_extent)
            for at, half_extent in small
            if (at + half_extent > low).all() and (at - half_extent < high).all()
        ]
        low = np.min([low, *(at - half_extent for at, half_extent in cut)], axis=0)
        high = np.max([high, *(at + half_extent for at, half_extent in cut)], axis=0)
    return low, high


def find_body_points_xy_w(record: RunRecord, row: int) -> Floats:
    """Return tail end, joints and head end on the ground in m, (joints + 2, 2). The pose must be known."""
    body_points_w = record.find_body_points_w(row)
    assert body_points_w is not None, "rows without a pose are not drawn"
    return body_points_w[:, :2]

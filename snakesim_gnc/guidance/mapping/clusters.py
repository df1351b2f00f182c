"""Finds clusters: runs of a scan's points that belong to one surface, cut at jumps and at concave corners. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.ranging.scan import AzimuthScan
from snakesim_hal.base.arrays import Floats

Indices = NDArray[np.intp]

# Jumps: the adaptive breakpoint detector, Borges 2004.
MIN_GRAZING_ANGLE_RAD = 0.26  # a surface seen under a smaller angle falls apart
MIN_JUMP_M = 0.02
MAX_MISSED_BINS = 1  # that dropped out within a surface
NOISE_MARGIN_SD = 3.0  # standard deviations that are added to a limit

# Concave corners.
# An obstacle is convex: its points are not this far behind the line between its ends.
MAX_CONCAVITY_M = 0.025
MIN_SPLIT_POINTS = 5  # a shorter run is not cut
MIN_CHORD_M = 1e-6


def find_clusters(scan: AzimuthScan) -> list[Indices]:
    """Divide a scan into clusters of bins that show one surface.

    A cluster ends at a missing stretch of bins, at a gap that is too wide for a surface seen at a grazing angle, and at
    a corner.

    Args:
        scan: Ranges by azimuth, with their points in the world.

    Returns:
        The indices of the bins of each cluster, in order of azimuth.
    """
    hits = np.flatnonzero(np.isfinite(scan.range_m))
    if len(hits) == 0:
        return []
    points_w = scan.points_w[hits]
    ranges_m = scan.range_m[hits]
    steps = np.diff(points_w, axis=0)
    gaps_m = np.hypot(steps[:, 0], steps[:, 1])
    bin_steps = np.diff(hits)
    nearer_m = np.minimum(ranges_m[:-1], ranges_m[1:])
    max_gap_m = bin_steps * nearer_m * scan.step_rad / math.sin(MIN_GRAZING_ANGLE_RAD)
    noise_m = NOISE_MARGIN_SD * np.maximum(scan.sd_m[hits[1:]], scan.sd_m[hits[:-1]])
    has_missed_bins = bin_steps > MAX_MISSED_BINS + 1
    is_wide_gap = gaps_m > np.maximum(max_gap_m, MIN_JUMP_M) + noise_m
    is_break = has_missed_bins | is_wide_gap
    clusters: list[Indices] = []
    for surface_bins in np.split(hits, np.flatnonzero(is_break) + 1):
        clusters += _split_at_corners(surface_bins, scan)
    return clusters


def _split_at_corners(surface_bins: Indices, scan: AzimuthScan) -> list[Indices]:
    """Split the bins of one surface where the surface is concave as seen from the sensor.

    Obstacles are convex, so a concave corner is between two obstacles.

    Args:
        surface_bins: Indices of successive bins, in order of azimuth.
        scan: The scan that the bins belong to.

    Returns:
        The bins of each part, in order of azimuth.
    """
    if len(surface_bins) < MIN_SPLIT_POINTS:
        return [surface_bins]
    depth_m = _compute_depth_behind_chord_m(scan.points_w[surface_bins], scan.origin_w)
    if depth_m is None:
        return [surface_bins]
    deepest_index = int(np.argmax(depth_m))
    is_convex = (
        depth_m[deepest_index]
        < MAX_CONCAVITY_M + NOISE_MARGIN_SD * scan.sd_m[surface_bins[deepest_index]]
    )
    is_inside = 1 < deepest_index < len(surface_bins) - 2
    if is_convex or not is_inside:
        return [surface_bins]
    return _split_at_corners(surface_bins[: deepest_index + 1], scan) + _split_at_corners(
        surface_bins[deepest_index + 1 :], scan
    )


def _compute_depth_behind_chord_m(points_w: Floats, origin_w: Floats) -> Floats | None:
    """Return how far points are behind the line from the first to the last point, as seen from the sensor.

    Args:
        points_w: (n, 2) points in the world, m.
        origin_w: (2,) position of the sensor, m.

    Returns:
        (n,) depths in m, negative for points in front of the line; None if the first and the last point coincide.
    """
    chord = points_w[-1] - points_w[0]
    length_m = math.hypot(*chord)
    if length_m < MIN_CHORD_M:
        return None
    direction_away = np.array([chord[1], -chord[0]]) / length_m
    if direction_away @ (points_w[0] - origin_w) < 0:
        direction_away = -direction_away
    return (points_w - points_w[0]) @ direction_away

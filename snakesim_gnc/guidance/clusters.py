"""Finds clusters: runs of a scan's points that belong to one surface, cut at jumps and at concave corners. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.scan import Scan
from snakesim_hal.base.arrays import Floats

Indices = NDArray[np.intp]

# Jumps: the adaptive breakpoint detector, Borges 2004.
GRAZING_RAD = 0.26  # a surface seen under a smaller angle falls apart
MIN_JUMP_M = 0.02
MAX_MISSED_BINS = 1  # that dropped out within a surface
NOISE_SD = 3.0  # standard deviations that are added to a limit

# Concave corners.
HOLLOW_M = 0.025  # an obstacle is convex: its points are not this far behind the line between its ends
MIN_RUN_POINTS = 5  # a shorter run is not cut
MIN_CHORD_M = 1e-6


def find_clusters(scan: Scan) -> list[Indices]:
    """Divide a scan into clusters of bins that show one surface.

    A cluster ends at a missing stretch of bins, at a gap that is too wide for a surface seen at a grazing angle, and at
    a corner.

    Args:
        scan: ranges by azimuth, with their points in the world.

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
    max_gap_m = bin_steps * nearer_m * scan.step_rad / math.sin(GRAZING_RAD)
    noise_m = NOISE_SD * np.maximum(scan.sd_m[hits[1:]], scan.sd_m[hits[:-1]])
    has_missed_bins = bin_steps > MAX_MISSED_BINS + 1
    is_wide_gap = gaps_m > np.maximum(max_gap_m, MIN_JUMP_M) + noise_m
    is_break = has_missed_bins | is_wide_gap
    clusters: list[Indices] = []
    for surface_bins in np.split(hits, np.flatnonzero(is_break) + 1):
        clusters += _split_at_corners(surface_bins, scan)
    return clusters


def _split_at_corners(run: Indices, scan: Scan) -> list[Indices]:
    """Return the parts of a run of bins, cut where it is hollow as seen from the sensor."""
    if len(run) < MIN_RUN_POINTS:
        return [run]
    behind_m = _distance_behind_chord_m(scan.points_w[run], scan.origin_w)
    if behind_m is None:
        return [run]
    deepest = int(np.argmax(behind_m))
    is_convex = behind_m[deepest] < HOLLOW_M + NOISE_SD * scan.sd_m[run[deepest]]
    is_inside = 1 < deepest < len(run) - 2
    if is_convex or not is_inside:
        return [run]
    return _split_at_corners(run[: deepest + 1], scan) + _split_at_corners(run[deepest + 1 :], scan)


def _distance_behind_chord_m(points_w: Floats, origin_w: Floats) -> Floats | None:
    """Return how far points (n, 2) are behind the line from the first to the last, as seen from an origin (2,).

    None if the first and the last point coincide.
    """
    chord = points_w[-1] - points_w[0]
    length_m = math.hypot(*chord)
    if length_m < MIN_CHORD_M:
        return None
    away = np.array([chord[1], -chord[0]]) / length_m
    if away @ (points_w[0] - origin_w) < 0:
        away = -away
    return (points_w - points_w[0]) @ away

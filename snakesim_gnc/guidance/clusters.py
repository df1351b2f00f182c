"""Clusters: runs of a scan's points that belong to one surface, cut at jumps and at concave corners. Pure."""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.scan import Scan

Indices = NDArray[np.intp]
GRAZING_RAD = 0.26  # a surface seen flatter than this falls apart (adaptive breakpoint detector, Borges 2004)
MIN_JUMP_M = 0.02
MISSED_BINS = 1  # dropped out within a surface
HOLLOW_M = 0.025  # an obstacle is convex: its points do not lie this far behind the line between its ends


def find_clusters(scan: Scan) -> list[Indices]:
    """Bins of each cluster, in order of azimuth."""
    hits = np.flatnonzero(np.isfinite(scan.range_m))
    if len(hits) == 0:
        return []
    points, ranges = scan.points_w[hits], scan.range_m[hits]
    gaps = np.hypot(*np.diff(points, axis=0).T)
    bins = np.diff(hits)
    allowed = bins * np.minimum(ranges[:-1], ranges[1:]) * scan.step_rad / math.sin(GRAZING_RAD)
    noise = 3 * np.maximum(scan.sd_m[hits[1:]], scan.sd_m[hits[:-1]])
    jumps = (bins > MISSED_BINS + 1) | (gaps > np.maximum(allowed, MIN_JUMP_M) + noise)
    found: list[Indices] = []
    for run in np.split(hits, np.flatnonzero(jumps) + 1):
        found += _convex_parts(run, scan)
    return found


def _convex_parts(run: Indices, scan: Scan) -> list[Indices]:
    """The run, cut where it is hollow as seen from the sensor."""
    if len(run) < 5:
        return [run]
    points = scan.points_w[run]
    chord = points[-1] - points[0]
    length = math.hypot(*chord)
    if length < 1e-6:
        return [run]
    away = np.array([chord[1], -chord[0]]) / length
    if away @ (points[0] - scan.origin_w) < 0:
        away = -away
    behind = (points - points[0]) @ away
    deepest = int(np.argmax(behind))
    if behind[deepest] < HOLLOW_M + 3 * scan.sd_m[run[deepest]] or not 1 < deepest < len(run) - 2:
        return [run]
    return _convex_parts(run[: deepest + 1], scan) + _convex_parts(run[deepest + 1 :], scan)

"""Scan matching: the pose of the base at which a scan fits the map, to correct dead reckoning. Pure.

Gauss-Newton on the distances of the scan's points from the outlines of well known obstacles. The same points refine the
map afterwards, so their information is counted at a share only.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_gnc.guidance.scan import Scan
from snakesim_gnc.guidance.tracks import Track, outlines_of, position_sd_m
from snakesim_hal.base.arrays import Floats

GATE_M = 0.05
MIN_POINTS = 8
MIN_BELIEF = 1.0  # log odds: seen a few times
SHARE = 0.1  # of the points' information
STEPS = 4
PROBE_M = 0.001


@dataclass(frozen=True)
class PoseMeasurement:
    """A measurement of the base's pose at the scan's stamp."""

    planar_w: Floats  # (3,) x, y, heading
    covariance: Floats  # (3, 3) against the map
    map_m2: float  # variance of the map's own place in the world


def matched(scan: Scan, tracks: Sequence[Track], base_w: Floats) -> PoseMeasurement | None:
    """base_w: (3,) the base as it was thought to be at the scan's stamp; None when too little of the scan is known."""
    known = [t for t in tracks if t.log_odds >= MIN_BELIEF and t.position_sd_m < 0.02 and t.size_sd_m < 0.02]
    hits = np.flatnonzero(np.isfinite(scan.range_m))
    if not known or len(hits) < MIN_POINTS:
        return None
    outlines, sd = outlines_of(known), position_sd_m(known)
    arm = scan.points_w[hits] - base_w[:2]
    by = np.zeros(3)
    information, weight, nearest = np.zeros((3, 3)), np.zeros(len(hits)), np.zeros(len(hits), dtype=np.intp)
    for _ in range(STEPS):
        c, s = np.cos(by[2]), np.sin(by[2])
        turned = arm @ np.array([[c, s], [-s, c]])
        points = base_w[:2] + by[:2] + turned
        distances = outlines.distance_m(points)
        nearest = np.abs(distances).argmin(axis=1)
        rows = np.arange(len(hits))
        off = distances[rows, nearest]
        slope = np.stack(
            [(outlines.distance_m(points + PROBE_M * axis)[rows, nearest] - off) / PROBE_M for axis in np.eye(2)],
            axis=1,
        )
        spread = np.hypot(np.hypot(scan.sd_m[hits], sd[nearest]), 0.003)
        ours = np.abs(off) < GATE_M
        if np.count_nonzero(ours) < MIN_POINTS:
            return None
        weight = ours / spread**2 * np.minimum(1.0, 2.0 * spread / np.maximum(np.abs(off), 1e-9))
        jacobian = np.column_stack([slope, slope[:, 1] * turned[:, 0] - slope[:, 0] * turned[:, 1]])
        information = jacobian.T @ (jacobian * weight[:, None])
        damping = np.diag([1.0, 1.0, 0.1])
        by = by - np.linalg.solve(information + damping, jacobian.T @ (weight * off))
    if np.hypot(by[0], by[1]) > GATE_M or abs(by[2]) > 0.1:
        return None
    covariance = np.asarray(np.linalg.inv(SHARE * information + np.eye(3)), dtype=np.float64)
    map_m2 = float(np.average([known[k].born_m2 for k in nearest], weights=weight))
    return PoseMeasurement(base_w + by, covariance, map_m2)

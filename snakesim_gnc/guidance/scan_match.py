"""Scan matching: estimates the pose of the base at which a scan fits the map, to correct dead reckoning. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.scan import Scan
from snakesim_gnc.guidance.tracks import Track, list_position_sd_m, make_outlines
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines

# Obstacles that the scan is matched to.
MIN_LOG_ODDS = 1.0  # seen a few times
MAX_MAP_SD_M = 0.02  # obstacles known less precisely do not help to localize

# Points that count.
GATE_M = 0.05  # distance from an outline; also the largest plausible correction
MIN_POINTS = 8
SENSOR_FLOOR_SD_M = 0.003  # range noise that the sensor model leaves out
HUBER_SD = 2.0  # standard deviations from which on a point counts less

# The iteration.
ITERATIONS = 4
PROBE_M = 0.001  # step of the numerical derivative
DAMPING = np.diag([1.0, 1.0, 0.1])
MAX_ROTATION_RAD = 0.1  # a larger correction means that the scan was matched to the wrong obstacles
INFORMATION_RATIO = 0.1  # of the points' information that counts: the same points refine the map afterwards


@dataclass(frozen=True)
class PoseMeasurement:
    """A measurement of the base's pose at the scan's timestamp."""

    planar_w: Floats  # (3,) x, y, heading
    covariance: Floats  # (3, 3) relative to the map
    map_m2: float  # variance of the map's own position in the world


@dataclass(frozen=True)
class _Residuals:
    """Distances of the scan's points from the outlines, at one correction; m is the number of points."""

    nearest: NDArray[np.intp]  # (m,) index of the nearest outline
    weight: Floats  # (m,) in 1 / m²; 0 for outliers
    information: Floats  # (3, 3) J^T W J
    gradient: Floats  # (3,) J^T W e
    inliers: int


def match_scan(scan: Scan, tracks: Sequence[Track], predicted_w: Floats) -> PoseMeasurement | None:
    """Estimate the base pose by aligning a range scan with known obstacles.

    Gauss-Newton with Huber weights on the distance from each scan point to the nearest obstacle outline (iterative
    closest point with point-to-outline residuals).

    Args:
        scan: its points are in the world, computed with the predicted pose.
        tracks: obstacles of the map; uncertain and imprecise ones are ignored.
        predicted_w: (3,) x, y and heading of the base at the scan's timestamp.

    Returns:
        The corrected pose, or None if too few points match or the correction is implausibly large.
    """
    landmarks = [track for track in tracks if _is_landmark(track)]
    hits = np.flatnonzero(np.isfinite(scan.range_m))
    if not landmarks or len(hits) < MIN_POINTS:
        return None
    outlines = make_outlines(landmarks)
    landmark_sd_m = list_position_sd_m(landmarks)
    arms = scan.points_w[hits] - predicted_w[:2]
    correction = np.zeros(3)
    residuals: _Residuals | None = None
    for _ in range(ITERATIONS):
        residuals = _compute_residuals(arms, scan.sd_m[hits], outlines, landmark_sd_m, predicted_w, correction)
        if residuals.inliers < MIN_POINTS:
            return None
        correction = correction - np.linalg.solve(residuals.information + DAMPING, residuals.gradient)
    if residuals is None or not _is_plausible(correction):
        return None
    information = INFORMATION_RATIO * residuals.information + np.eye(3)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    landmark_variances_m2 = [landmarks[k].born_m2 for k in residuals.nearest]
    map_m2 = float(np.average(landmark_variances_m2, weights=residuals.weight))
    return PoseMeasurement(predicted_w + correction, covariance, map_m2)


def _compute_residuals(
    arms: Floats, sd_m: Floats, outlines: Outlines, landmark_sd_m: Floats, predicted_w: Floats, correction: Floats
) -> _Residuals:
    """Compute the distances e of scan points from the nearest outlines, and the terms of a Gauss-Newton step.

    With J the derivatives of e by the correction, and W the Huber weights, the information is J^T W J and the gradient
    J^T W e. Points farther than GATE_M from every outline have no weight.

    Args:
        arms: (m, 2) scan points relative to the predicted base position, m.
        sd_m: (m,) standard deviations of the points.
        outlines: outlines of the landmarks.
        landmark_sd_m: standard deviation of each landmark's position.
        predicted_w: (3,) predicted x and y in m, and heading in rad.
        correction: (3,) present correction of the predicted pose.

    Returns:
        The nearest outline and the weight of each point, the information (3, 3) and the gradient (3,).
    """
    cosine = np.cos(correction[2])
    sine = np.sin(correction[2])
    rotated = arms @ np.array([[cosine, sine], [-sine, cosine]])
    points_w = predicted_w[:2] + correction[:2] + rotated
    rows = np.arange(len(arms))
    all_distances_m = outlines.distance_m(points_w)  # (m, outlines)
    nearest = np.abs(all_distances_m).argmin(axis=1)
    distance_m = all_distances_m[rows, nearest]

    slopes: list[Floats] = []  # of the distance along x and y
    for axis in np.eye(2):
        probed_m = outlines.distance_m(points_w + PROBE_M * axis)[rows, nearest]
        slopes.append((probed_m - distance_m) / PROBE_M)
    slope = np.stack(slopes, axis=1)
    slope_by_heading = slope[:, 1] * rotated[:, 0] - slope[:, 0] * rotated[:, 1]
    jacobian = np.column_stack([slope, slope_by_heading])

    spread_m = np.hypot(np.hypot(sd_m, landmark_sd_m[nearest]), SENSOR_FLOOR_SD_M)
    is_inlier = np.abs(distance_m) < GATE_M
    huber = np.minimum(1.0, HUBER_SD * spread_m / np.maximum(np.abs(distance_m), 1e-9))
    weight = is_inlier / spread_m**2 * huber
    return _Residuals(
        nearest=nearest,
        weight=weight,
        information=jacobian.T @ (jacobian * weight[:, None]),
        gradient=jacobian.T @ (weight * distance_m),
        inliers=int(np.count_nonzero(is_inlier)),
    )


def _is_landmark(track: Track) -> bool:
    return track.log_odds >= MIN_LOG_ODDS and track.position_sd_m < MAX_MAP_SD_M and track.size_sd_m < MAX_MAP_SD_M


def _is_plausible(correction: Floats) -> bool:
    is_too_far = np.hypot(correction[0], correction[1]) > GATE_M
    is_turned_too_far = abs(correction[2]) > MAX_ROTATION_RAD
    return not (is_too_far or is_turned_too_far)

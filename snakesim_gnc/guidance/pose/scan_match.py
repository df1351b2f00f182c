"""Scan matching: estimates the pose of the base at which a scan fits the map, to correct dead reckoning. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.mapping.tracks import ObstacleTrack, get_position_sds_m, make_outlines
from snakesim_gnc.guidance.ranging.scan import AzimuthScan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines

# Obstacles that the scan is matched to.
MIN_LOG_ODDS = 1.0  # seen a few times
MAX_LANDMARK_SD_M = 0.02  # obstacles known less precisely do not help to localize

# Points that count.
MAX_MATCH_DISTANCE_M = 0.05  # distance from an outline; also the largest plausible correction
MIN_POINTS = 8
MIN_RANGE_SD_M = 0.003  # range noise that the sensor model leaves out
HUBER_THRESHOLD_SD = 2.0  # standard deviations from which on a point counts less

# The iteration.
ITERATIONS = 4
DERIVATIVE_STEP_M = 0.001  # step of the numerical derivative
DAMPING = np.diag([1.0, 1.0, 0.1])
MAX_ROTATION_RAD = 0.1  # a larger correction means that the scan was matched to the wrong obstacles
# Of the points' information that counts: the same points refine the map afterwards.
INFORMATION_RATIO = 0.1


@dataclass(frozen=True)
class PoseMeasurement:
    """A measurement of the base pose at the timestamp of a scan."""

    planar_w: Floats  # (3,) x, y, heading
    covariance: Floats  # (3, 3) relative to the map
    # Variance of the position of the matched obstacles in the world, the same in x and y.
    map_variance_m2: float


@dataclass(frozen=True)
class _ScanResiduals:
    """Distances of m scan points from the nearest outlines for one pose correction, as terms of a Gauss-Newton step."""

    nearest: NDArray[np.intp]  # (m,) index of the nearest outline
    weight: Floats  # (m,) Huber weights in 1 / m²; 0 for outliers
    information: Floats  # (3, 3) J^T W J
    gradient: Floats  # (3,) J^T W e
    inlier_count: int


def match_scan(
    scan: AzimuthScan, tracks: Sequence[ObstacleTrack], predicted_w: Floats
) -> PoseMeasurement | None:
    """Estimate the base pose by aligning a range scan with known obstacles.

    Gauss-Newton with Huber weights on the distance from each scan point to the nearest obstacle outline (iterative
    closest point with point-to-outline residuals).

    Args:
        scan: The scan, whose points in the world were computed with the predicted pose.
        tracks: Obstacles of the map. Those that are uncertain or imprecise are ignored.
        predicted_w: (3,) x, y and heading of the base at the scan's timestamp.

    Returns:
        The corrected pose, or None if too few points match or the correction is implausibly large.
    """
    landmarks = [track for track in tracks if _is_landmark(track)]
    hits = np.flatnonzero(np.isfinite(scan.range_m))
    if not landmarks or len(hits) < MIN_POINTS:
        return None
    outlines = make_outlines(landmarks)
    landmark_sd_m = get_position_sds_m(landmarks)
    offsets_from_base_w = scan.points_w[hits] - predicted_w[:2]
    correction = np.zeros(3)
    residuals: _ScanResiduals | None = None
    for _ in range(ITERATIONS):
        residuals = _compute_residuals(
            offsets_from_base_w, scan.sd_m[hits], outlines, landmark_sd_m, predicted_w, correction
        )
        if residuals.inlier_count < MIN_POINTS:
            return None
        correction = correction - np.linalg.solve(
            residuals.information + DAMPING, residuals.gradient
        )
    if residuals is None or not _is_plausible(correction):
        return None
    information = INFORMATION_RATIO * residuals.information + np.eye(3)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    landmark_variances_m2 = [landmarks[k].initial_variance_m2 for k in residuals.nearest]
    map_variance_m2 = float(np.average(landmark_variances_m2, weights=residuals.weight))
    return PoseMeasurement(predicted_w + correction, covariance, map_variance_m2)


def _compute_residuals(
    offsets_from_base_w: Floats,
    sd_m: Floats,
    outlines: ObstacleOutlines,
    landmark_sd_m: Floats,
    predicted_w: Floats,
    correction: Floats,
) -> _ScanResiduals:
    """Compute the distances e of scan points from the nearest outlines, and the terms of a Gauss-Newton step.

    With J the derivatives of e by the correction, and W the Huber weights, the information is J^T W J and the gradient
    J^T W e. Points farther than MAX_MATCH_DISTANCE_M from every outline have no weight.

    Args:
        offsets_from_base_w: (m, 2) scan points relative to the predicted base position, m.
        sd_m: (m,) standard deviations of the points.
        outlines: Outlines of the landmarks.
        landmark_sd_m: Standard deviation of each landmark's position.
        predicted_w: (3,) predicted x and y in m, and heading in rad.
        correction: (3,) current correction of the predicted pose.

    Returns:
        The nearest outline and the weight of each point, the information (3, 3) and the gradient (3,).
    """
    # The scan points with the corrected pose, (m, 2): rotated about the base, and moved.
    cosine = np.cos(correction[2])
    sine = np.sin(correction[2])
    rotated = offsets_from_base_w @ np.array([[cosine, sine], [-sine, cosine]])
    points_w = predicted_w[:2] + correction[:2] + rotated

    # Distance e of each point from its nearest outline, (m,).
    rows = np.arange(len(offsets_from_base_w))
    all_distances_m = outlines.compute_distances_m(points_w)  # (m, outlines)
    nearest = np.abs(all_distances_m).argmin(axis=1)
    distance_m = all_distances_m[rows, nearest]

    # J, (m, 3): derivatives of the distances by a shift along x and y, by differences, and by the heading.
    slopes: list[Floats] = []
    for axis in np.eye(2):
        shifted_points_w = points_w + DERIVATIVE_STEP_M * axis
        shifted_distance_m = outlines.compute_distances_m(shifted_points_w)[rows, nearest]
        slopes.append((shifted_distance_m - distance_m) / DERIVATIVE_STEP_M)
    slope_by_shift = np.stack(slopes, axis=1)
    slope_by_heading = slope_by_shift[:, 1] * rotated[:, 0] - slope_by_shift[:, 0] * rotated[:, 1]
    jacobian = np.column_stack([slope_by_shift, slope_by_heading])

    # W, (m,): inverse variances, reduced for large distances, and 0 for points that belong to no landmark.
    distance_sd_m = np.hypot(np.hypot(sd_m, landmark_sd_m[nearest]), MIN_RANGE_SD_M)
    is_inlier = np.abs(distance_m) < MAX_MATCH_DISTANCE_M
    huber_factors = np.minimum(
        1.0, HUBER_THRESHOLD_SD * distance_sd_m / np.maximum(np.abs(distance_m), 1e-9)
    )
    weights = is_inlier / distance_sd_m**2 * huber_factors
    return _ScanResiduals(
        nearest=nearest,
        weight=weights,
        information=jacobian.T @ (jacobian * weights[:, None]),
        gradient=jacobian.T @ (weights * distance_m),
        inlier_count=int(np.count_nonzero(is_inlier)),
    )


def _is_landmark(track: ObstacleTrack) -> bool:
    return (
        track.log_odds >= MIN_LOG_ODDS
        and track.position_sd_m < MAX_LANDMARK_SD_M
        and track.size_sd_m < MAX_LANDMARK_SD_M
    )


def _is_plausible(correction: Floats) -> bool:
    is_too_far = np.hypot(correction[0], correction[1]) > MAX_MATCH_DISTANCE_M
    is_turned_too_far = abs(correction[2]) > MAX_ROTATION_RAD
    return not (is_too_far or is_turned_too_far)

"""Fits circles to the visible parts of surfaces, with covariance; many obstacles at once. Pure.

Gauss-Newton on the distances of points from the circle, with a prior on the radius. The visible arc of a cylinder fixes
center and radius. A short arc leaves both uncertain along the line of sight; the covariance shows that.

In shapes, b is the number of obstacles and p the number of points of each.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

PRIOR_RADIUS_M = 0.05  # prior of an obstacle before it was seen
PRIOR_RADIUS_SD_M = 0.03
MIN_RADIUS_M = 0.01
MAX_RADIUS_M = 0.5
CENTER_PRIOR_INFORMATION = 1.0  # 1 / m², a prior so weak that it only keeps the equations regular
ITERATIONS = 5
MAX_STEP_M = 0.04
OUTLIER_THRESHOLD_SD = 3.0  # standard deviations from which on a point counts less
# Of real surfaces from a circle or box, and of points that are means over a cell.
SHAPE_MODEL_SD_M = 0.0015


@dataclass(frozen=True)
class FittedCircles:
    """Circles in the world, one a row."""

    center_w: Floats  # (b, 2)
    radius_m: Floats  # (b,)
    covariance: Floats  # (b, 3, 3) of x, y, radius
    fit_cost: Floats  # (b,) sum of squared, weighted, limited distances


def fit_circles(
    points_w: Floats,
    weights: Floats,
    outward_directions: Floats,
    normal_weights: Floats,
    initial_centers_w: Floats,
) -> FittedCircles:
    """Fit a circle with center c and radius r to the points q of each obstacle.

    Minimizes the sum of w (|q - c| - r)² with Huber weights, of (r - r_0)² / sd_0², and of v (a . (q - c))²: the
    measured normal of a touch, to which a is perpendicular, leads through the center.

    Args:
        points_w: (b, p, 2) the p points q of each of the b obstacles in the world, m.
        weights: (b, p) w, information in 1 / m²; 0 for padding.
        outward_directions: (b, p, 2) unit vectors from the surface towards the sensor, or normals.
        normal_weights: (b, p) v, information of `outward_directions` as a normal; 0 for points that were only seen.
        initial_centers_w: (b, 2) centers of earlier fits, from which the iteration starts; NaN without one.

    Returns:
        One circle for each obstacle, with the covariance (3, 3) of x, y and radius, and the misfit.
    """
    weights = soften_weights(weights)
    centers_w, radii_m = _make_initial_circles(
        points_w, weights, outward_directions, initial_centers_w
    )
    information = np.zeros((len(points_w), 3, 3))
    for _ in range(ITERATIONS):
        offset = points_w - centers_w[:, None]
        information, gradient = _linearize(
            offset, radii_m, weights, outward_directions, normal_weights
        )
        # Gauss-Newton step (b, 3) of x, y and radius, shortened so that no component exceeds MAX_STEP_M.
        step = -np.linalg.solve(information, gradient[..., None])[..., 0]
        longest_m = np.maximum(np.abs(step).max(axis=1), 1e-9)
        step *= np.minimum(1.0, MAX_STEP_M / longest_m)[:, None]
        centers_w = centers_w + step[:, :2]
        radii_m = np.clip(radii_m + step[:, 2], MIN_RADIUS_M, MAX_RADIUS_M)
    offset = points_w - centers_w[:, None]
    error_m = np.hypot(offset[..., 0], offset[..., 1]) - radii_m[:, None]
    fit_cost = np.minimum(weights * error_m * error_m, OUTLIER_THRESHOLD_SD**2).sum(axis=1)
    surplus_points = np.maximum((weights > 0).sum(axis=1) - 3, 1)
    # If the points scatter more than their weights imply, the covariance is larger by that ratio.
    excess = np.maximum(fit_cost / surplus_points, 1.0)
    return FittedCircles(
        centers_w, radii_m, np.linalg.inv(information) * excess[:, None, None], fit_cost
    )


def soften_weights(weights: Floats) -> Floats:
    """Return weights (b, p) with the deviation of real surfaces from any model added; 0 stays 0."""
    return weights / (1.0 + weights * SHAPE_MODEL_SD_M**2)


def _make_initial_circles(
    points_w: Floats, weights: Floats, outward_directions: Floats, initial_centers_w: Floats
) -> tuple[Floats, Floats]:
    """Return initial centers and radii of the circles, from which the Gauss-Newton iteration starts.

    A center is that of the earlier fit or, without one, PRIOR_RADIUS_M behind the mean of the points.

    Args:
        points_w: (b, p, 2) points in the world, m.
        weights: (b, p) information of the points in 1 / m²; 0 for padding.
        outward_directions: (b, p, 2) unit vectors out of the surface.
        initial_centers_w: (b, 2) centers of earlier fits, m; NaN without one.

    Returns:
        Centers (b, 2) in m, and radii (b,) in m, which are the mean distances of the points from the center.
    """
    ratio = weights / weights.sum(axis=1, keepdims=True)
    behind_surface = np.einsum("bp,bpk->bk", ratio, points_w - PRIOR_RADIUS_M * outward_directions)
    centers_w = np.where(np.isnan(initial_centers_w), behind_surface, initial_centers_w)
    distances_m = np.hypot(
        points_w[..., 0] - centers_w[:, None, 0], points_w[..., 1] - centers_w[:, None, 1]
    )
    return centers_w, np.einsum("bp,bp->b", ratio, distances_m)


def _linearize(
    offsets_m: Floats,
    radii_m: Floats,
    weights: Floats,
    outward_directions: Floats,
    normal_weights: Floats,
) -> tuple[Floats, Floats]:
    """Linearize the circle fit at the current circles, for a Gauss-Newton step of x, y and radius.

    Args:
        offsets_m: (b, p, 2) points from the center of their circle, m.
        radii_m: (b,) radii, m.
        weights: (b, p) information of the points in 1 / m².
        outward_directions: (b, p, 2) unit vectors from the surface towards the sensor, or normals.
        normal_weights: (b, p) information of `outward_directions` as a normal; 0 for points that were only seen.

    Returns:
        Information matrices (b, 3, 3) and gradients (b, 3).
    """
    distances_m = np.maximum(np.hypot(offsets_m[..., 0], offsets_m[..., 1]), 1e-9)
    errors_m = distances_m - radii_m[:, None]
    huber_factors = np.minimum(
        1.0, OUTLIER_THRESHOLD_SD / np.maximum(np.abs(errors_m) * np.sqrt(weights), 1e-9)
    )
    robust_weights = weights * huber_factors
    # Derivatives of the distance error of each point by x, y and radius: (b, p, 3).
    rows = np.stack(
        [
            -offsets_m[..., 0] / distances_m,
            -offsets_m[..., 1] / distances_m,
            -np.ones_like(distances_m),
        ],
        axis=-1,
    )
    information = np.einsum("bp,bpi,bpj->bij", robust_weights, rows, rows)
    gradient = np.einsum("bp,bpi->bi", robust_weights * errors_m, rows)

    # The line through a point along its measured normal leads through the center. The error is the distance of the
    # center from this line, and `normal_rows` are its derivatives: (b, p, 3).
    normal_rows = np.stack(
        [outward_directions[..., 1], -outward_directions[..., 0], np.zeros_like(distances_m)],
        axis=-1,
    )
    normal_errors_m = np.einsum("bpk,bpk->bp", normal_rows[..., :2], -offsets_m)
    information += np.einsum("bp,bpi,bpj->bij", normal_weights, normal_rows, normal_rows)
    gradient += np.einsum("bp,bpi->bi", normal_weights * normal_errors_m, normal_rows)

    # Priors.
    information[:, 2, 2] += PRIOR_RADIUS_SD_M**-2
    gradient[:, 2] += (radii_m - PRIOR_RADIUS_M) * PRIOR_RADIUS_SD_M**-2
    information[:, [0, 1], [0, 1]] += CENTER_PRIOR_INFORMATION
    return information, gradient

"""Fits circles to the visible parts of surfaces, with covariance; many obstacles at once. Pure.

Gauss-Newton on the distances of points from the circle, with a prior on the radius. The visible arc of a cylinder fixes
center and radius. A short arc leaves both uncertain along the line of sight; the covariance shows that.

In shapes, b is the number of obstacles and p the number of points of each.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

RADIUS_M = 0.05  # prior of an obstacle before it was seen
RADIUS_SD_M = 0.03
MIN_RADIUS_M = 0.01
MAX_RADIUS_M = 0.5
CENTER_INFORMATION = 1.0  # 1 / m², a prior so weak that it only keeps the equations regular
ITERATIONS = 5
MAX_STEP_M = 0.04
OUTLIER_SD = 3.0  # standard deviations from which on a point counts less
MODEL_SD_M = 0.0015  # of real surfaces from a circle or box, and of points that are means over a cell


@dataclass(frozen=True)
class Circles:
    """Circles in the world, one a row."""

    center_w: Floats  # (b, 2)
    radius_m: Floats  # (b,)
    covariance: Floats  # (b, 3, 3) of x, y, radius
    misfit: Floats  # (b,) sum of squared, weighted, limited distances


def fit_circles(
    points: Floats, weight: Floats, outward: Floats, normal_weight: Floats, initial_center_w: Floats
) -> Circles:
    """Fit a circle with center c and radius r to the points q of each obstacle.

    Minimizes the sum of w (|q - c| - r)² with Huber weights, of (r - r_0)² / sd_0², and of v (a . (q - c))²: the
    measured normal of a touch, to which a is perpendicular, leads through the center.

    Args:
        points: (b, p, 2) the p points q of each of the b obstacles in the world, m.
        weight: (b, p) w, information in 1 / m²; 0 for padding.
        outward: (b, p, 2) unit vectors from the surface towards the sensor, or normals.
        normal_weight: (b, p) v, information of `outward` as a normal; 0 for points that were only seen.
        initial_center_w: (b, 2) centers of earlier fits, from which the iteration starts; NaN without one.

    Returns:
        One circle for each obstacle, with the covariance (3, 3) of x, y and radius, and the misfit.
    """
    weight = soften_weights(weight)
    center, radius = _first_guess(points, weight, outward, initial_center_w)
    information = np.zeros((len(points), 3, 3))
    for _ in range(ITERATIONS):
        offset = points - center[:, None]
        information, gradient = _linearize(offset, radius, weight, outward, normal_weight)
        step = -np.linalg.solve(information, gradient[..., None])[..., 0]
        longest_m = np.maximum(np.abs(step).max(axis=1), 1e-9)
        step *= np.minimum(1.0, MAX_STEP_M / longest_m)[:, None]
        center = center + step[:, :2]
        radius = np.clip(radius + step[:, 2], MIN_RADIUS_M, MAX_RADIUS_M)
    offset = points - center[:, None]
    error_m = np.hypot(offset[..., 0], offset[..., 1]) - radius[:, None]
    misfit = np.minimum(weight * error_m * error_m, OUTLIER_SD**2).sum(axis=1)
    surplus_points = np.maximum((weight > 0).sum(axis=1) - 3, 1)
    # If the points scatter more than their weights imply, the covariance is larger by that ratio.
    excess = np.maximum(misfit / surplus_points, 1.0)
    return Circles(center, radius, np.linalg.inv(information) * excess[:, None, None], misfit)


def soften_weights(weight: Floats) -> Floats:
    """Return weights (b, p) with the deviation of real surfaces from any model added; 0 stays 0."""
    return weight / (1.0 + weight * MODEL_SD_M**2)


def _first_guess(points: Floats, weight: Floats, outward: Floats, initial_center_w: Floats) -> tuple[Floats, Floats]:
    """Return centers (b, 2), from the earlier fit or one prior radius behind the surface, and mean radii (b,)."""
    ratio = weight / weight.sum(axis=1, keepdims=True)
    behind_surface = np.einsum("bp,bpk->bk", ratio, points - RADIUS_M * outward)
    center = np.where(np.isnan(initial_center_w), behind_surface, initial_center_w)
    distance_m = np.hypot(points[..., 0] - center[:, None, 0], points[..., 1] - center[:, None, 1])
    return center, np.einsum("bp,bp->b", ratio, distance_m)


def _linearize(
    offset: Floats, radius: Floats, weight: Floats, outward: Floats, normal_weight: Floats
) -> tuple[Floats, Floats]:
    """Linearize the circle fit at the present circles, for a Gauss-Newton step of x, y and radius.

    Args:
        offset: (b, p, 2) points from the center of their circle, m.
        radius: (b,) radii, m.
        weight: (b, p) information of the points in 1 / m².
        outward: (b, p, 2) unit vectors from the surface towards the sensor, or normals.
        normal_weight: (b, p) information of `outward` as a normal; 0 for points that were only seen.

    Returns:
        Information matrices (b, 3, 3) and gradients (b, 3).
    """
    distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 1e-9)
    error = distance - radius[:, None]
    huber = np.minimum(1.0, OUTLIER_SD / np.maximum(np.abs(error) * np.sqrt(weight), 1e-9))
    trusted = weight * huber
    rows = np.stack([-offset[..., 0] / distance, -offset[..., 1] / distance, -np.ones_like(distance)], axis=-1)
    information = np.einsum("bp,bpi,bpj->bij", trusted, rows, rows)
    gradient = np.einsum("bp,bpi->bi", trusted * error, rows)

    # The line through a point along its measured normal leads through the center.
    across = np.stack([outward[..., 1], -outward[..., 0], np.zeros_like(distance)], axis=-1)
    miss = np.einsum("bpk,bpk->bp", across[..., :2], -offset)
    information += np.einsum("bp,bpi,bpj->bij", normal_weight, across, across)
    gradient += np.einsum("bp,bpi->bi", normal_weight * miss, across)

    # Priors.
    information[:, 2, 2] += RADIUS_SD_M**-2
    gradient[:, 2] += (radius - RADIUS_M) * RADIUS_SD_M**-2
    information[:, [0, 1], [0, 1]] += CENTER_INFORMATION
    return information, gradient

"""Fits the ground as a plane, from the body that lies on it and from what a camera sees of it. Pure.

On hills the plane is that of the ground near the head. Points that are off the plane by less than `compute_tolerance_m`
are still ground. A plane is an array (3,) of a, b, c in z = a + b x + c y.
"""

import numpy as np

from snakesim_hal.base.arrays import Floats

# Deviation of the ground from its plane.
FLATNESS_TOLERANCE_M = 0.015  # near the robot
FLATNESS_TOLERANCE_PER_M = 0.02  # in addition, for each meter of distance

MAX_FIT_RANGE_M = 1.5  # the plane is fitted to nearer points
MAX_SLOPE = 0.3

# The plane under the body.
NEAR_WEIGHT_M = 0.1  # a point counts 1 / (its distance + this): the ground near the camera matters
LEVEL_PRIOR_WEIGHTS = np.diag([0.0, 0.02, 0.02])  # pulls slopes that the body does not show to zero

# The plane that a camera sees.
MIN_POINTS = 30
TUKEY_WIDTHS_M = (0.04, 0.025)  # of the Tukey weights in each iteration
ABOVE_WIDTH_RATIO = 0.5  # of the width, for points above the plane: obstacles are above it
FIRST_GUESS_WEIGHTS = np.diag([1.0, 0.3, 0.3])  # weight of the first guess


def compute_tolerance_m(range_m: Floats) -> Floats:
    """Return the distance in m by which the ground may be above or below its plane, at ranges from the robot."""
    return FLATNESS_TOLERANCE_M + FLATNESS_TOLERANCE_PER_M * range_m


def fit_plane_under_body(lowest_points_w: Floats, plane_origin_w: Floats) -> Floats:
    """Fit the plane under the body, by weighted least squares.

    The slope across a straight body is unknown, and assumed to be zero.

    Args:
        lowest_points_w: (n, 3) lowest points of the links in the world, m.
        plane_origin_w: (2,) point in the world from which x and y of the plane count, m.

    Returns:
        (3,) plane a, b, c in z = a + b x + c y. The slopes b and c are limited to MAX_SLOPE.
    """
    x, y = (lowest_points_w[:, :2] - plane_origin_w[:2]).T
    rows = np.stack([np.ones_like(x), x, y], axis=1)
    weights = 1.0 / (NEAR_WEIGHT_M + np.hypot(x, y))
    normal_matrix = rows.T @ (rows * weights[:, None]) + LEVEL_PRIOR_WEIGHTS
    plane = np.linalg.solve(normal_matrix, rows.T @ (lowest_points_w[:, 2] * weights))
    return np.clip(plane, [-np.inf, -MAX_SLOPE, -MAX_SLOPE], [np.inf, MAX_SLOPE, MAX_SLOPE])


def refine_plane(plane: Floats, points: Floats) -> Floats:
    """Fit the ground plane to the points near it, by iteratively reweighted least squares with Tukey weights.

    The width of the weights decreases from iteration to iteration. Above the plane it is narrower than below, because
    obstacles stand on the ground. A prior draws the result towards the first guess.

    Args:
        plane: (3,) first guess of (a, b, c) in z = a + b x + c y.
        points: (n, 3) points x, y, z, m.

    Returns:
        The fitted plane, or the first guess if too few points are near it or the fit is too steep.
    """
    x, y, z = points.T
    rows = np.stack([np.ones_like(x), x, y], axis=1)
    first_guess = plane
    for width_m in TUKEY_WIDTHS_M:
        above_m = z - rows @ plane
        max_distance_m = np.where(above_m > 0, ABOVE_WIDTH_RATIO * width_m, width_m)
        tukey_weights = np.clip(1.0 - np.square(above_m / max_distance_m), 0.0, None) ** 2
        if np.count_nonzero(tukey_weights) < MIN_POINTS:
            return first_guess
        right_side = rows.T @ (z * tukey_weights) + FIRST_GUESS_WEIGHTS @ first_guess
        plane = np.linalg.solve(
            rows.T @ (rows * tukey_weights[:, None]) + FIRST_GUESS_WEIGHTS, right_side
        )
    if np.abs(plane[1:]).max() < MAX_SLOPE:
        return plane
    return first_guess

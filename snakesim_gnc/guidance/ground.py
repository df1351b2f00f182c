"""The ground as a plane, from the body that lies on it and from what a camera sees of it. Pure.

On hills the plane is that of the ground near the head; what is off it by less than `tolerance_m` is still ground.
"""

import numpy as np

from snakesim_hal.base.arrays import Floats

FLAT_M, PER_M = 0.015, 0.02  # deviation of ground from its plane: near the robot, and more for each metre of distance
NEAR_M = 1.5  # the plane is fitted to what is nearer
MIN_POINTS = 30
MAX_SLOPE = 0.3


def tolerance_m(range_m: Floats) -> Floats:
    """How far above or below the plane a point of the ground may be, at a distance."""
    return FLAT_M + PER_M * range_m


def fit_plane_under(bottoms_w: Floats, at_w: Floats) -> Floats:
    """The plane under the body: (3,) a, b, c of z = a + b x + c y, with x and y from `at_w`.

    bottoms_w: (n, 3) lowest points of the links. The slope across a straight body is unknown, and taken as none.
    """
    x, y = (bottoms_w[:, :2] - at_w[:2]).T
    rows = np.stack([np.ones_like(x), x, y], axis=1)
    weights = 1.0 / (0.1 + np.hypot(x, y))  # the ground near the camera counts
    level = np.diag([0.0, 0.02, 0.02])  # pulls slopes that the body does not show to zero
    normal = rows.T @ (rows * weights[:, None]) + level
    plane = np.linalg.solve(normal, rows.T @ (bottoms_w[:, 2] * weights))
    return np.clip(plane, [-np.inf, -MAX_SLOPE, -MAX_SLOPE], [np.inf, MAX_SLOPE, MAX_SLOPE])


def refine_plane(plane: Floats, points: Floats) -> Floats:
    """The plane fitted to the seen points (n, 3) near it, by iterated reweighting (Tukey); or as it was.

    Obstacles are above it, so points above count less than points below.
    """
    x, y, z = points.T
    rows = np.stack([np.ones_like(x), x, y], axis=1)
    first = plane
    for width in (0.04, 0.025):
        off = z - rows @ plane
        weights = np.clip(1.0 - np.square(off / np.where(off > 0, 0.5 * width, width)), 0.0, None) ** 2
        if np.count_nonzero(weights) < MIN_POINTS:
            return first
        prior = np.diag([1.0, 0.3, 0.3])
        right = rows.T @ (z * weights) + prior @ first
        plane = np.linalg.solve(rows.T @ (rows * weights[:, None]) + prior, right)
    return plane if np.abs(plane[1:]).max() < MAX_SLOPE else first

"""Vectors in the plane of the ground. Pure."""

import numpy as np

from snakesim_hal.base.arrays import Floats


def cross(a: Floats, b: Floats) -> Floats:
    """a x b of vectors (..., 2), a scalar: a_x b_y - a_y b_x."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def wrenches(points_w: Floats, forces_w: Floats) -> Floats:
    """Forces (..., 2) at points (..., 2) as (force x, force y, moment about the origin), (..., 3)."""
    return np.concatenate([forces_w, cross(points_w, forces_w)[..., None]], axis=-1)

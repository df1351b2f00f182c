"""Vectors and curves in the plane of the ground. Pure."""

import numpy as np

from snakesim_hal.base.arrays import Floats

SPACING_M = 0.01  # of the points that `resample_evenly` makes


def cross_2d(a: Floats, b: Floats) -> Floats:
    """Return the scalar cross product a x b = a_x b_y - a_y b_x of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def compute_wrenches(points_w: Floats, forces_w: Floats) -> Floats:
    """Return forces (..., 2) at points (..., 2) as (force x, force y, moment about the origin), (..., 3)."""
    return np.concatenate([forces_w, cross_2d(points_w, forces_w)[..., None]], axis=-1)


def resample_evenly(points_w: Floats) -> Floats:
    """Return points (k, 2) about SPACING_M apart along a curve through points (n, 2); the first and last stay."""
    s_m = _compute_arc_lengths_m(points_w)
    count = max(round(s_m[-1] / SPACING_M), 2) + 1
    return _interpolate_points(points_w, s_m, np.linspace(0.0, s_m[-1], count))


def sample_back_from_end(points_w: Floats, spacing_m: float, step_count: int) -> Floats:
    """Return points (steps + 1, 2) along a curve through points (n, 2), of which the last is its end.

    Where the curve is too short, the points are at its beginning.
    """
    s_m = _compute_arc_lengths_m(points_w)
    return _interpolate_points(points_w, s_m, s_m[-1] - spacing_m * np.arange(step_count, -1, -1.0))


def _compute_arc_lengths_m(points_w: Floats) -> Floats:
    chords = np.diff(points_w, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(chords[:, 0], chords[:, 1]))))


def _interpolate_points(points_w: Floats, s_m: Floats, sample_s_m: Floats) -> Floats:
    x = np.interp(sample_s_m, s_m, points_w[:, 0])
    y = np.interp(sample_s_m, s_m, points_w[:, 1])
    return np.stack([x, y], axis=-1)

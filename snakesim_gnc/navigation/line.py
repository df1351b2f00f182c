"""Points along a line on the ground. Pure."""

import numpy as np

from snakesim_hal.base.arrays import Floats

SPACING_M = 0.01


def evenly(points_w: Floats) -> Floats:
    """Points (n, 2) along a line, about `SPACING_M` apart; the first and the last stay."""
    s = _arc_lengths(points_w)
    return _at(points_w, s, np.linspace(0.0, s[-1], max(round(s[-1] / SPACING_M), 2) + 1))


def back_from_end(points_w: Floats, spacing_m: float, steps: int) -> Floats:
    """Points (steps + 1, 2) along a line, the last at its end; those before its beginning are there."""
    s = _arc_lengths(points_w)
    return _at(points_w, s, s[-1] - spacing_m * np.arange(steps, -1, -1.0))


def _arc_lengths(points_w: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points_w, axis=0).T))))


def _at(points_w: Floats, s: Floats, at: Floats) -> Floats:
    return np.stack([np.interp(at, s, points_w[:, k]) for k in (0, 1)], axis=-1)

"""Smoothing and differentiation of recorded signals along time, all through one short window. Pure.

Every signal of an estimate passes the same window: no noisy signal is differentiated, and no signal lags another.
"""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

HALF_WINDOW_TICKS = 5  # ticks to either side; a smoothed signal is shorter by twice as many


def smooth(signal: Floats) -> Floats:
    """Return a signal smoothed along its first axis, (ticks - 2 HALF_WINDOW_TICKS, ...)."""
    return filter_columns(signal, _make_window())


def smooth_derivative(signal: Floats, period_s: float) -> Floats:
    """Return the time derivative of the smoothed signal, in the signal's unit per second."""
    return filter_columns(signal, _make_window(1) / period_s)


def smooth_second_derivative(signal: Floats, period_s: float) -> Floats:
    """Return the second time derivative of the smoothed signal, in the signal's unit per second squared."""
    return filter_columns(signal, _make_window(2) / period_s**2)


def filter_columns(signal: Floats, kernel: Floats) -> Floats:
    """Convolve each column with a kernel, and keep only the samples that the whole kernel covers."""
    return np.apply_along_axis(lambda column: np.convolve(column, kernel, "valid"), 0, signal)


def average_with_neighbors(signal: Floats) -> Floats:
    """Return the mean of each sample with its two neighbors, (ticks,)."""
    padded = np.pad(signal, 1, mode="edge")
    return (padded[:-2] + padded[1:-1] + padded[2:]) / 3


def compute_motion_direction(velocity_rad_s: Floats) -> Floats:
    """Return the sign of a velocity averaged over each tick, (ticks,), from -1 to 1.

    Within the tick in which a joint reverses, the velocity is taken as a straight line, so the average of its sign is
    the fraction of the tick in forward motion minus the fraction in backward motion.
    """
    velocity = average_with_neighbors(velocity_rad_s)
    before = np.roll(velocity, 1)
    before[0] = velocity[0]
    after = np.roll(velocity, -1)
    after[-1] = velocity[-1]
    change_in_tick = np.maximum(np.abs(after - before) / 2, 1e-9)
    return np.clip(2 * velocity / change_in_tick, -1.0, 1.0)


def is_slow(
    velocity_rad_s: Floats, threshold_rad_s: float, max_fraction: float
) -> NDArray[np.bool_]:
    """Return where at least `max_fraction` of the smoothing window is slow, (ticks - 2 HALF_WINDOW_TICKS,)."""
    is_slow_tick = (np.abs(average_with_neighbors(velocity_rad_s)) < threshold_rad_s).astype(float)
    return smooth(is_slow_tick) >= max_fraction


def _make_window(derivative_order: int = 0) -> Floats:
    """Make the power-of-cosine smoothing window, or its first or second derivative with respect to ticks.

    With s = pi / (2 HALF_WINDOW_TICKS), at tick k from the middle:

        w(k)   = cos(s k)^4 / sum
        w'(k)  = -4 s cos(s k)^3 sin(s k) / sum
        w''(k) = s^2 (12 cos(s k)^2 sin(s k)^2 - 4 cos(s k)^4) / sum

    `sum` is the sum of cos(s k)^4 over the window, so that w sums to 1.

    Finite differences instead of w'' would bias accelerations low, and hence the estimated rotor inertia high.

    Args:
        derivative_order: 0 for the window, 1 or 2 for its first or second derivative.

    Returns:
        (2 HALF_WINDOW_TICKS + 1,) weights of the samples, oldest first.

    Raises:
        ValueError: There is no such derivative.
    """
    phase_step = np.pi / (2 * HALF_WINDOW_TICKS)
    phase = np.arange(-HALF_WINDOW_TICKS, HALF_WINDOW_TICKS + 1) * np.pi / (2 * HALF_WINDOW_TICKS)
    cos = np.cos(phase)
    sin = np.sin(phase)
    match derivative_order:
        case 0:
            shape = cos**4
        case 1:
            shape = -4 * cos**3 * sin * phase_step
        case 2:
            shape = (12 * cos**2 * sin**2 - 4 * cos**4) * phase_step**2
        case _:
            raise ValueError(f"the derivative of order {derivative_order} is not available")
    return shape / np.sum(cos**4)

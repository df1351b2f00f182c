"""Fits how the motion of a joint in run B follows that in run A: the lag and the gain."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

MAX_LAG_S = 0.25
MIN_DEVIATION = 1e-6  # a joint of A with a smaller standard deviation did not move
MIN_SAMPLES = 20
LAG_RESOLUTION_S = 1e-5


@dataclass(frozen=True)
class LagAndGain:
    """Fit of B(t) = gain * A(t - lag) + constant."""

    lag_s: float  # positive if B is later
    gain: float
    residual_rms: float  # RMS of B minus the fit, in the unit of the data


def fit_lag_and_gain(time_s: Floats, a: Floats, b: Floats) -> LagAndGain | None:
    """Fit lag and gain of one joint by least squares: b(t) = gain * a(t - lag) + constant.

    A grid search with the time step of the data finds the best lag. Its neighbors are then tried with a step that is
    halved until it is below LAG_RESOLUTION_S.

    Args:
        time_s: (n,) common times, in s.
        a: (n,) values in A.
        b: (n,) values in B.

    Returns:
        The fit, or None if the joint did not move, or some of its values are unknown.
    """
    if len(time_s) < MIN_SAMPLES or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return None
    # Leave out both ends, so that A is known at each time shifted by the largest lag.
    max_lag_s = min(MAX_LAG_S, float(time_s[-1] - time_s[0]) / 4)
    is_inside = (time_s >= time_s[0] + max_lag_s) & (time_s <= time_s[-1] - max_lag_s)
    if is_inside.sum() < MIN_SAMPLES or np.std(a[is_inside]) < MIN_DEVIATION:
        return None
    fit_time_s = time_s[is_inside]
    centered_b = b[is_inside] - b[is_inside].mean()

    def fit_gain(lag_s: float) -> tuple[float, float, float]:
        """Return the RMS of the residual, the lag, and the gain that minimizes the residual at this lag."""
        shifted_a = np.interp(fit_time_s - lag_s, time_s, a)
        shifted_a -= shifted_a.mean()
        sum_of_squares = float(shifted_a @ shifted_a)
        gain = float(shifted_a @ centered_b) / sum_of_squares if sum_of_squares > 0 else 0.0
        residual = centered_b - gain * shifted_a
        residual_rms = float(np.sqrt(residual @ residual / len(residual)))
        return residual_rms, lag_s, gain

    # Tuples compare by their first item, so that `min` selects the fit with the smallest residual.
    step_s = float(np.median(np.diff(time_s)))
    max_step_count = max(int(max_lag_s / step_s), 1)
    best = min(fit_gain(steps * step_s) for steps in range(-max_step_count, max_step_count + 1))
    while step_s > LAG_RESOLUTION_S:
        step_s /= 2
        best_lag_s = best[1]
        best = min(best, fit_gain(best_lag_s - step_s), fit_gain(best_lag_s + step_s))
    residual_rms, lag_s, gain = best
    return LagAndGain(lag_s, gain, residual_rms)

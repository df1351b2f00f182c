"""How one joint's motion in B follows that in A: how much later, and how much larger. Pure."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

MAX_LAG_S = 0.25
MIN_DEVIATION = 1e-6  # a joint of A with a smaller standard deviation did not move
MIN_INSTANTS = 20
LAG_RESOLUTION_S = 1e-5


@dataclass(frozen=True)
class Following:
    """B(t) is about gain * A(t - lag), but for a constant."""

    lag_s: float  # above 0: B is later
    gain: float
    left: float  # RMS of B less that, in the unit of both


def following(time_s: Floats, a: Floats, b: Floats) -> Following | None:
    """Fit lag and gain of one joint by least squares: b(t) = gain * a(t - lag) + constant.

    The lag is found by a grid search whose step is halved until it is below LAG_RESOLUTION_S.

    Args:
        time_s: (n,) the common times.
        a: (n,) values in A.
        b: (n,) values in B.

    Returns:
        The fit, or None if the joint did not move, or some of its values are unknown.
    """
    if len(time_s) < MIN_INSTANTS or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return None
    max_lag_s = min(MAX_LAG_S, float(time_s[-1] - time_s[0]) / 4)
    within = (time_s >= time_s[0] + max_lag_s) & (time_s <= time_s[-1] - max_lag_s)
    if within.sum() < MIN_INSTANTS or np.std(a[within]) < MIN_DEVIATION:
        return None
    at_s = time_s[within]
    target = b[within] - b[within].mean()

    def fit(lag_s: float) -> tuple[float, float, float]:
        """Return the RMS that is left, the lag and the best gain for it."""
        moved = np.interp(at_s - lag_s, time_s, a)
        moved -= moved.mean()
        power = float(moved @ moved)
        gain = float(moved @ target) / power if power > 0 else 0.0
        left = target - gain * moved
        return float(np.sqrt(left @ left / len(left))), lag_s, gain

    step_s = float(np.median(np.diff(time_s)))
    count = max(int(max_lag_s / step_s), 1)
    left, lag_s, gain = min(fit(lag * step_s) for lag in range(-count, count + 1))
    while step_s > LAG_RESOLUTION_S:
        step_s /= 2
        left, lag_s, gain = min((left, lag_s, gain), fit(lag_s - step_s), fit(lag_s + step_s))
    return Following(lag_s, gain, left)

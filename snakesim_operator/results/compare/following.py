"""How one joint's motion in B follows that in A: how much later, and how much larger. Pure."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

MOST_S = 0.25  # of a lag that is looked for
LEAST_MOTION = 1e-6  # standard deviation in A, of which less is none
LEAST_INSTANTS = 20


@dataclass(frozen=True)
class Following:
    """B(t) is about gain * A(t - lag), but for a constant."""

    lag_s: float  # above 0: B is later
    gain: float
    left: float  # RMS of B less that, in the unit of both


def following(time_s: Floats, a: Floats, b: Floats) -> Following | None:
    """Of one joint; None where it did not move, or is not known throughout. All are (n,)."""
    if len(time_s) < LEAST_INSTANTS or not (np.isfinite(a).all() and np.isfinite(b).all()):
        return None
    max_s = min(MOST_S, float(time_s[-1] - time_s[0]) / 4)
    within = (time_s >= time_s[0] + max_s) & (time_s <= time_s[-1] - max_s)
    if within.sum() < LEAST_INSTANTS or np.std(a[within]) < LEAST_MOTION:
        return None
    at_s, wanted = time_s[within], b[within] - b[within].mean()

    def fit(lag_s: float) -> tuple[float, float, float]:
        moved = np.interp(at_s - lag_s, time_s, a)
        moved -= moved.mean()
        power = float(moved @ moved)
        gain = float(moved @ wanted) / power if power > 0 else 0.0
        left = wanted - gain * moved
        return float(np.sqrt(left @ left / len(left))), lag_s, gain

    step_s = float(np.median(np.diff(time_s)))
    count = max(int(max_s / step_s), 1)
    left, lag_s, gain = min(fit(lag * step_s) for lag in range(-count, count + 1))
    while step_s > 1e-5:
        step_s /= 2
        left, lag_s, gain = min((left, lag_s, gain), fit(lag_s - step_s), fit(lag_s + step_s))
    return Following(lag_s, gain, left)

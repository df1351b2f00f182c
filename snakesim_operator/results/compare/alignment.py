"""Two records on one time axis: the robot's time since its first arming, over the time that both have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.time_axis import zero_s

SAME_INSTANT_S = 1e-6


@dataclass(frozen=True)
class Joints:
    """What the joints of one run did on the common time axis; every array is (n, joints), tail to head."""

    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats
    mode: NDArray[np.int8]
    target: Floats  # in the unit of the mode


@dataclass(frozen=True)
class Aligned:
    """Both runs at the same instants."""

    time_s: Floats  # (n,) since the first arming
    a: Joints
    b: Joints
    how: str  # in words, for people who judge the numbers


def align(a: RunRecord, b: RunRecord) -> Aligned:
    """Tick by tick where the ticks coincide; else both at the ticks of the one that has fewer.

    What is measured is interpolated between ticks; a setpoint holds until the next one.
    """
    time_a, time_b = a.time_s - zero_s(a), b.time_s - zero_s(b)
    until_s = min(float(time_a[-1]), float(time_b[-1])) + SAME_INSTANT_S
    within_a, within_b = time_a[time_a <= until_s], time_b[time_b <= until_s]
    if len(within_a) == len(within_b) and np.allclose(within_a, within_b, rtol=0, atol=SAME_INSTANT_S):
        grid, how = within_a, "tick by tick"
    else:
        grid, coarser, finer = (within_a, "A", "B") if len(within_a) <= len(within_b) else (within_b, "B", "A")
        rates = f"A at {a.config.rate_hz:g} Hz, B at {b.config.rate_hz:g} Hz"
        if a.config.rate_hz == b.config.rate_hz:
            rates = f"both at {a.config.rate_hz:g} Hz, but some ticks are missing"
        how = f"{rates}: {finer} is interpolated at the ticks of {coarser}"
    return Aligned(grid, _at(a, time_a, grid), _at(b, time_b, grid), how)


def _at(record: RunRecord, time_s: Floats, grid: Floats) -> Joints:
    held = np.searchsorted(time_s, grid + SAME_INSTANT_S, side="right") - 1
    if np.allclose(time_s[held], grid, rtol=0, atol=SAME_INSTANT_S):
        measured = [series[held] for series in (record.angle_rad, record.velocity_rad_s, record.torque_nm)]
    else:
        measured = [
            np.column_stack([np.interp(grid, time_s, column) for column in series.T])
            for series in (record.angle_rad, record.velocity_rad_s, record.torque_nm)
        ]
    return Joints(measured[0], measured[1], measured[2], record.mode[held], record.target[held])

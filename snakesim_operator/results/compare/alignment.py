"""Two records on one time axis: the robot's time since its first arming, over the time that both have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.run_log import RunRecord
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
    """Both runs at the same times."""

    time_s: Floats  # (n,) since the first arming
    a: Joints
    b: Joints
    how: str  # in words, for people who judge the numbers


def align(a: RunRecord, b: RunRecord) -> Aligned:
    """Sample two runs at common times, over the time that both have.

    If both have the same ticks, these are the common times. Otherwise they are the ticks of the run that has fewer, and
    the other run is sampled there: measured values are interpolated, and a setpoint holds until the next one.

    Args:
        a: The first run.
        b: The second run.

    Returns:
        The joints of both runs at the common times, and a description of how they were sampled.
    """
    time_a = a.time_s - zero_s(a)
    time_b = b.time_s - zero_s(b)
    common_end_s = min(float(time_a[-1]), float(time_b[-1])) + SAME_INSTANT_S
    common_time_a = time_a[time_a <= common_end_s]
    common_time_b = time_b[time_b <= common_end_s]
    has_same_ticks = len(common_time_a) == len(common_time_b) and np.allclose(
        common_time_a, common_time_b, rtol=0, atol=SAME_INSTANT_S
    )
    if has_same_ticks:
        grid = common_time_a
        how = "tick by tick"
    elif len(common_time_a) <= len(common_time_b):
        grid = common_time_a
        how = f"{_describe_rates(a, b)}: B is interpolated at the ticks of A"
    else:
        grid = common_time_b
        how = f"{_describe_rates(a, b)}: A is interpolated at the ticks of B"
    return Aligned(grid, _sample_joints(a, time_a, grid), _sample_joints(b, time_b, grid), how)


def _describe_rates(a: RunRecord, b: RunRecord) -> str:
    if a.config.rate_hz == b.config.rate_hz:
        return f"both at {a.config.rate_hz:g} Hz, but some ticks are missing"
    return f"A at {a.config.rate_hz:g} Hz, B at {b.config.rate_hz:g} Hz"


def _sample_joints(record: RunRecord, time_s: Floats, grid: Floats) -> Joints:
    """Return what the joints of a run did at the times of a grid, (n,)."""
    newest_rows = np.searchsorted(time_s, grid + SAME_INSTANT_S, side="right") - 1
    on_grid = np.allclose(time_s[newest_rows], grid, rtol=0, atol=SAME_INSTANT_S)

    def sample(series: Floats) -> Floats:
        if on_grid:
            return series[newest_rows]
        return np.column_stack([np.interp(grid, time_s, column) for column in series.T])

    return Joints(
        angle_rad=sample(record.angle_rad),
        velocity_rad_s=sample(record.velocity_rad_s),
        torque_nm=sample(record.torque_nm),
        mode=record.mode[newest_rows],
        target=record.target[newest_rows],
    )

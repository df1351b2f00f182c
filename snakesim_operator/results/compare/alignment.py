"""Samples two records on a common time axis: robot time since the first arming, over the time that both have."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import get_time_origin_s

TIME_TOLERANCE_S = 1e-6


@dataclass(frozen=True)
class JointSeries:
    """Time series of the joints of one run on the common time axis. Every array is (n, joints), tail to head."""

    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats
    mode: NDArray[np.int8]
    target: Floats  # in the unit of the mode


@dataclass(frozen=True)
class AlignedRuns:
    """The joints of both runs at common times."""

    time_s: Floats  # (n,) since the first arming
    a: JointSeries
    b: JointSeries
    sampling_description: str  # how the runs were sampled, as text


def align_runs(a: RunRecord, b: RunRecord) -> AlignedRuns:
    """Sample two runs at common times, over the time that both have.

    If both have the same ticks, these are the common times. Otherwise they are the ticks of the run that has fewer, and
    the other run is sampled there: measured values are interpolated, and a setpoint holds until the next one.

    Args:
        a: The first run.
        b: The second run.

    Returns:
        The joints of both runs at the common times, and a description of how they were sampled.
    """
    time_a_s = a.time_s - get_time_origin_s(a)
    time_b_s = b.time_s - get_time_origin_s(b)
    common_end_s = min(float(time_a_s[-1]), float(time_b_s[-1])) + TIME_TOLERANCE_S
    common_time_a_s = time_a_s[time_a_s <= common_end_s]
    common_time_b_s = time_b_s[time_b_s <= common_end_s]
    has_same_ticks = len(common_time_a_s) == len(common_time_b_s) and np.allclose(
        common_time_a_s, common_time_b_s, rtol=0, atol=TIME_TOLERANCE_S
    )
    if has_same_ticks:
        grid_s = common_time_a_s
        how = "tick by tick"
    elif len(common_time_a_s) <= len(common_time_b_s):
        grid_s = common_time_a_s
        how = f"{_describe_rates(a, b)}: B is interpolated at the ticks of A"
    else:
        grid_s = common_time_b_s
        how = f"{_describe_rates(a, b)}: A is interpolated at the ticks of B"
    return AlignedRuns(
        grid_s, _sample_joints(a, time_a_s, grid_s), _sample_joints(b, time_b_s, grid_s), how
    )


def _describe_rates(a: RunRecord, b: RunRecord) -> str:
    if a.config.rate_hz == b.config.rate_hz:
        return f"both at {a.config.rate_hz:g} Hz, but some ticks are missing"
    return f"A at {a.config.rate_hz:g} Hz, B at {b.config.rate_hz:g} Hz"


def _sample_joints(record: RunRecord, time_s: Floats, grid_s: Floats) -> JointSeries:
    """Sample the joints of a run at the times of a grid, (n,) in s.

    Measured values are interpolated unless the grid consists of ticks of the run. A setpoint holds until the next one.
    """
    newest_rows = np.searchsorted(time_s, grid_s + TIME_TOLERANCE_S, side="right") - 1
    is_on_ticks = np.allclose(time_s[newest_rows], grid_s, rtol=0, atol=TIME_TOLERANCE_S)

    def sample(series: Floats) -> Floats:
        if is_on_ticks:
            return series[newest_rows]
        return np.column_stack([np.interp(grid_s, time_s, column) for column in series.T])

    return JointSeries(
        angle_rad=sample(record.angle_rad),
        velocity_rad_s=sample(record.velocity_rad_s),
        torque_nm=sample(record.torque_nm),
        mode=record.mode[newest_rows],
        target=record.target[newest_rows],
    )

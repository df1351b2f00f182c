"""Extracts time series from a record: states, propulsion intervals, references and distance."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.metrics.motion import StopIntervals
from snakesim_operator.results.metrics.propulsion import PropulsionInterval
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.sampling import choose_even_indices
from snakesim_operator.results.summary import measure_route_position_m
from snakesim_operator.results.time_axis import (
    LabeledInterval,
    get_report_time_s,
    get_time_origin_s,
    list_control_state_spans,
    merge_equal_reports,
)

POSE_SAMPLES = 400
STATES = {
    "Locomoting": "moving as meant",
    "NotLocomoting": "not moving",
    "Idle": "idle",
    "PowerOff": "power off",
}
MIN_MISMATCH_S = 1.0  # control measures motion over a preceding window of this length


@dataclass(frozen=True)
class TimelineSeries:
    """Values over time with a label that names them."""

    time_s: Floats
    values: Floats
    label: str


def describe_state(state: str) -> str:
    """Describe a locomotion state in plain words."""
    return STATES.get(state, state)


def find_state_intervals(record: RunRecord) -> list[LabeledInterval]:
    """Find the intervals of the locomotion states that control reported; each lasts until the next report."""
    return merge_equal_reports(record, [state.state for state in record.control_states])


@dataclass(frozen=True)
class FalseNotLocomotingReports:
    """Control reported for some time that the body did not locomote while it moved."""

    duration_s: float
    start_s: float
    reason: str  # the reason that was reported for longest


def find_false_not_locomoting_reports(
    record: RunRecord, stop_intervals: StopIntervals
) -> FalseNotLocomotingReports | None:
    """Find where the controller reported NotLocomoting although the body was moving.

    Args:
        record: The recorded run.
        stop_intervals: Measured intervals without motion.

    Returns:
        Total duration, first start and main reason of these reports; None if they lasted less than MIN_MISMATCH_S.
    """
    duration_s_by_reason: dict[str, float] = {}
    start_times_s: list[float] = []
    for start_s, end_s, state in list_control_state_spans(record):
        claims_no_locomotion = state.state == "NotLocomoting" and state.reason != STANDING_STILL
        if (
            not claims_no_locomotion
            or end_s <= start_s
            or stop_intervals.is_stationary_at((start_s + end_s) / 2)
        ):
            continue
        duration_s_by_reason[state.reason] = (
            duration_s_by_reason.get(state.reason, 0.0) + end_s - start_s
        )
        start_times_s.append(start_s)
    total_s = sum(duration_s_by_reason.values())
    if total_s < MIN_MISMATCH_S:
        return None
    return FalseNotLocomotingReports(
        total_s,
        start_times_s[0],
        max(duration_s_by_reason, key=lambda reason: duration_s_by_reason[reason]),
    )


def find_longest_reason(record: RunRecord, interval: LabeledInterval) -> str:
    """Return the reason for no motion that control reported for longest in an interval; without any, STANDING_STILL."""
    duration_s_by_reason: dict[str, float] = {}
    for start_s, end_s, state in list_control_state_spans(record):
        overlap_s = min(end_s, interval.end_s) - max(start_s, interval.start_s)
        if state.state != "Locomoting" and overlap_s > 0:
            duration_s_by_reason[state.reason] = (
                duration_s_by_reason.get(state.reason, 0.0) + overlap_s
            )
    return (
        max(duration_s_by_reason, key=lambda reason: duration_s_by_reason[reason], default="")
        or STANDING_STILL
    )


def find_jam_intervals(record: RunRecord) -> list[LabeledInterval]:
    """Find the intervals in which the controller reported a jam."""
    intervals = merge_equal_reports(
        record, ["jammed" if state.jammed else None for state in record.control_states]
    )
    return [interval for interval in intervals if interval.label == "jammed"]


def join_intervals(intervals: list[PropulsionInterval], gap_s: float) -> list[PropulsionInterval]:
    """Join intervals of the same joint with a gap of less than `gap_s`, which a chart could not show separately."""
    merged: list[PropulsionInterval] = []
    newest_index: dict[int, int] = {}  # into `merged`, by joint
    for interval in intervals:
        index = newest_index.get(interval.joint_index)
        if index is not None and interval.start_s - merged[index].end_s < gap_s:
            merged[index] = PropulsionInterval(
                merged[index].start_s, interval.end_s, interval.joint_index
            )
        else:
            newest_index[interval.joint_index] = len(merged)
            merged.append(interval)
    return merged


def find_most_propelling_joints(
    intervals: list[PropulsionInterval], max_count: int = 6
) -> list[int]:
    """Find the indices of the joints that propelled longest, from head to tail, the usual order of hand-overs."""
    duration_s_by_joint: dict[int, float] = {}
    for interval in intervals:
        duration_s_by_joint[interval.joint_index] = (
            duration_s_by_joint.get(interval.joint_index, 0.0) + interval.duration_s
        )
    longest = sorted(duration_s_by_joint, key=lambda joint: -duration_s_by_joint[joint])[:max_count]
    return sorted(longest, reverse=True)


def compute_reference_rad(record: RunRecord, joint_index: int) -> Floats:
    """Return the reference angle of a joint, (n,): its target in position mode, else as the controller reported it."""
    reference = np.full(len(record.time_s), np.nan)
    states = [state for state in record.control_states if len(state.reference_rad) > joint_index]
    if states:
        timestamps_s = np.array([state.timestamp_ns * 1e-9 for state in states])
        angles = np.array([state.reference_rad[joint_index] for state in states])
        reference = np.interp(record.time_s, timestamps_s, angles, left=np.nan, right=angles[-1])
    in_position = record.mode[:, joint_index] == JointMode.POSITION
    return np.where(in_position, record.target[:, joint_index], reference)


def select_commanded_torque_nm(record: RunRecord, joint_index: int) -> Floats:
    """Return the commanded torque of a joint in torque mode, (n,); NaN in all other modes."""
    return np.where(
        record.mode[:, joint_index] == JointMode.TORQUE, record.target[:, joint_index], np.nan
    )


@lru_cache(maxsize=2)  # chart and comparison of two runs need the same series
def measure_distance(record: RunRecord) -> TimelineSeries | None:
    """Measure how far the robot advanced since the first tick, as a series over time.

    The best available measure is used: the mean position of the body along the route; without a route, the distance of
    the tail end from its start; without a measured pose, the advance that the controller reported.

    Args:
        record: The recorded run.

    Returns:
        The series, whose label names the measurement; None if nothing is known of the advance.
    """
    tick_count = len(record.time_s)
    if not tick_count:
        return read_reported_distance(record)
    sampled_rows = choose_even_indices(tick_count, POSE_SAMPLES)
    rows = sampled_rows[record.has_pose[sampled_rows]]
    if len(rows) < 2:
        return read_reported_distance(record)
    time_s = record.time_s[rows] - get_time_origin_s(record)
    route_positions_m = [measure_route_position_m(record, int(row)) for row in rows]
    if None not in route_positions_m:
        along_m = np.array(route_positions_m, dtype=np.float64)
        return TimelineSeries(
            time_s, along_m - along_m[0], "advance along the route, mean over the body"
        )
    displacement_w = record.position_w_m[rows, :2] - record.position_w_m[rows[0], :2]
    return TimelineSeries(
        time_s, np.hypot(*displacement_w.T), "distance of the tail end from where it was"
    )


def read_reported_distance(record: RunRecord) -> TimelineSeries | None:
    """Return the advance of the tail along the path, as the controller reported it; None if it is unknown."""
    states = [state for state in record.control_states if state.path_s_m is not None]
    if len(states) < 2:
        return None
    along = np.array([state.path_s_m for state in states], dtype=np.float64)
    timestamps_s = np.array([get_report_time_s(record, state) for state in states])
    return TimelineSeries(
        timestamps_s,
        along - along[0],
        "advance of the tail along the path, as the controller knew it",
    )

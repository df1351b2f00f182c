"""Time series of a record: states, propulsion intervals, references, distance; all from the first tick on."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.wire.messages import Mode
from snakesim_operator.results.metrics.motion import Motion
from snakesim_operator.results.metrics.propulsion import Propulsion
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import arc_position_m
from snakesim_operator.results.time_axis import Interval, merge_reports, reported_at_s, reported_spans, zero_s

POSE_SAMPLES = 400
STATES = {"Locomoting": "moving as meant", "NotLocomoting": "not moving", "Idle": "idle", "PowerOff": "power off"}
MIN_MISMATCH_S = 1.0  # control's own measurement of motion looks back for as long


@dataclass(frozen=True)
class Series:
    """Values over time, and what they are."""

    time_s: Floats
    value: Floats
    what: str


def in_words(state: str) -> str:
    """Return a state of locomotion in plain words."""
    return STATES.get(state, state)


def state_bands(record: RunRecord) -> list[Interval]:
    """Return the locomotion states that control reported; each holds until the next is reported."""
    return merge_reports(record, [state.state for state in record.control])


@dataclass(frozen=True)
class Mismatch:
    """Control reported for some time that the body did not locomote, and it moved."""

    lasted_s: float
    since_s: float
    reason: str  # that was reported for longest


def reported_while_moving(record: RunRecord, motion: Motion) -> Mismatch | None:
    """Return what control reported as a reason for no motion while the body moved; None if that was short."""
    lasted_s: dict[str, float] = {}
    since_s: list[float] = []
    for since, until, state in reported_spans(record):
        is_report = state.state == "NotLocomoting" and state.reason != STANDING_STILL
        if not is_report or until <= since or motion.is_stationary_at((since + until) / 2):
            continue
        lasted_s[state.reason] = lasted_s.get(state.reason, 0.0) + until - since
        since_s.append(since)
    total_s = sum(lasted_s.values())
    if total_s < MIN_MISMATCH_S:
        return None
    return Mismatch(total_s, since_s[0], max(lasted_s, key=lambda reason: lasted_s[reason]))


def longest_reason(record: RunRecord, span: Interval) -> str:
    """Return the reason for standing that control reported for longest within a span; else what was measured."""
    lasted_s: dict[str, float] = {}
    for since, until, state in reported_spans(record):
        overlap_s = min(until, span.end_s) - max(since, span.start_s)
        if state.state != "Locomoting" and overlap_s > 0:
            lasted_s[state.reason] = lasted_s.get(state.reason, 0.0) + overlap_s
    return max(lasted_s, key=lambda reason: lasted_s[reason], default="") or STANDING_STILL


def jam_bands(record: RunRecord) -> list[Interval]:
    """Return when the controller reported that the snake was jammed."""
    bands = merge_reports(record, ["jammed" if state.jammed else None for state in record.control])
    return [band for band in bands if band.what == "jammed"]


def joined(intervals: list[Propulsion], gap_s: float) -> list[Propulsion]:
    """Join intervals of one joint with less than a gap between them: a chart could not show them apart."""
    merged: list[Propulsion] = []
    newest_index: dict[int, int] = {}  # by joint
    for interval in intervals:
        index = newest_index.get(interval.joint)
        if index is not None and interval.start_s - merged[index].end_s < gap_s:
            merged[index] = Propulsion(merged[index].start_s, interval.end_s, interval.joint)
        else:
            newest_index[interval.joint] = len(merged)
            merged.append(interval)
    return merged


def most_used_joints(intervals: list[Propulsion], most: int = 6) -> list[int]:
    """Return the joints that propelled longest, from head to tail, in which order hand-overs happen."""
    spent: dict[int, float] = {}
    for interval in intervals:
        spent[interval.joint] = spent.get(interval.joint, 0.0) + interval.duration_s
    longest = sorted(spent, key=lambda joint: -spent[joint])[:most]
    return sorted(longest, reverse=True)


def reference_rad(record: RunRecord, joint: int) -> Floats:
    """Return a joint's reference, (n,): its target in position mode, else as the controller reported it."""
    reference = np.full(len(record.time_s), np.nan)
    states = [state for state in record.control if len(state.reference_rad) > joint]
    if states:
        stamps = np.array([state.timestamp_ns * 1e-9 for state in states])
        angles = np.array([state.reference_rad[joint] for state in states])
        reference = np.interp(record.time_s, stamps, angles, left=np.nan, right=angles[-1])
    in_position = record.mode[:, joint] == Mode.POSITION
    return np.where(in_position, record.target[:, joint], reference)


def commanded_torque_nm(record: RunRecord, joint: int) -> Floats:
    """Return the torque that was commanded in torque mode, (n,); NaN in every other mode."""
    return np.where(record.mode[:, joint] == Mode.TORQUE, record.target[:, joint], np.nan)


@lru_cache(maxsize=2)  # the chart and the comparison of two runs ask for the same series
def distance(record: RunRecord) -> Series | None:
    """Return how far the robot advanced since the first tick, as a series over time.

    The best available measure is used: the mean position of the body along the route; without a route, the distance of
    the tail end from where it was; without a measured pose, the advance that the controller reported.

    Args:
        record: The recorded run.

    Returns:
        The series, whose label names the measurement; None if nothing is known of the advance.
    """
    tick_count = len(record.time_s)
    if not tick_count:
        return reported_distance(record)
    sample_count = min(tick_count, POSE_SAMPLES)
    sampled_rows = np.unique(np.linspace(0, tick_count - 1, sample_count).astype(int))
    rows = sampled_rows[record.posed[sampled_rows]]
    if len(rows) < 2:
        return reported_distance(record)
    time_s = record.time_s[rows] - zero_s(record)
    route_positions_m = [arc_position_m(record, int(row)) for row in rows]
    if None not in route_positions_m:
        along_m = np.array(route_positions_m, dtype=np.float64)
        return Series(time_s, along_m - along_m[0], "advance along the route, mean over the body")
    displacement_w = record.position_w_m[rows, :2] - record.position_w_m[rows[0], :2]
    return Series(time_s, np.hypot(*displacement_w.T), "distance of the tail end from where it was")


def reported_distance(record: RunRecord) -> Series | None:
    """Return the advance of the tail since the controller first reported its place on the path."""
    states = [state for state in record.control if state.path_s_m is not None]
    if len(states) < 2:
        return None
    along = np.array([state.path_s_m for state in states], dtype=np.float64)
    stamps = np.array([reported_at_s(record, state) for state in states])
    return Series(stamps, along - along[0], "advance of the tail along the path, as the controller knew it")

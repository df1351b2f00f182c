"""Judges a run: makes its verdict, a short text with a rating."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.model.robot_file.checked import START_CHECK_CONTROLLER
from snakesim_hal.wire.messages import Fault
from snakesim_operator.results.metrics.motion import StopIntervals, find_stops
from snakesim_operator.results.report.phrases import (
    MOVED_M,
    describe_contradiction,
    describe_distance,
    describe_ending,
    describe_hand_overs,
    describe_last_control_state,
    describe_pushed_obstacles,
    describe_refused_commands,
    describe_trouble,
    end_with_full_stop,
)
from snakesim_operator.results.report.timeline import find_longest_reason
from snakesim_operator.results.run_ending import COMPLETE
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary, get_distance_m, get_estimates
from snakesim_operator.results.time_axis import get_report_time_s, get_run_end_s

MIN_STOP_S = 0.5  # a shorter stop at the end is not mentioned
# A run that was stationary for a larger fraction, and at its end, is rated poor.
MAX_STANDING_FRACTION = 0.5
MIN_MOVED_RAD = 1e-3  # a joint whose target changed by less, such as by rounding, was not moved
JUDGING_COMMANDS = {  # by controller that does not locomote, the command that judges its run
    START_CHECK_CONTROLLER: "snakesim robot check",
    "identify": "snakesim robot identify",
}
Kind = Literal["good", "poor", "bad"]


@dataclass(frozen=True)
class RunVerdict:
    """A text about the result of a run, and its rating."""

    rating: Kind
    text: str


@dataclass(frozen=True)
class LocomotionStop:
    """The end of locomotion, before the end of the run."""

    time_s: float
    reason: str
    is_intended: bool


def make_verdict(record: RunRecord, summary: RunSummary) -> RunVerdict:
    """Make the verdict on a run, with a sentence about numbers that are estimates."""
    verdict = _judge_run(record, summary)
    estimates = "; ".join(get_estimates(summary).describe())
    if not estimates:
        return verdict
    return RunVerdict(
        verdict.rating, f"{verdict.text} {end_with_full_stop(estimates.capitalize())}"
    )


def _judge_run(record: RunRecord, summary: RunSummary) -> RunVerdict:
    if summary.ticks == 0 and len(record.time_s) == 0 and not summary.faults:
        return RunVerdict(
            "bad", f"Nothing was recorded: the robot was never armed ({summary.ended})."
        )
    stopping_faults = [fault for fault in summary.faults if fault.scope == "robot"]
    if stopping_faults:
        return _judge_stopped_run(record, summary, stopping_faults[0])
    command = JUDGING_COMMANDS.get(record.config.controller)
    if command is not None:
        return _judge_joint_test(record, summary, command)
    stop_intervals = find_stops(record)
    if stop_intervals is None:
        moved = describe_distance(record, summary)
        rest = f"{describe_hand_overs(summary)}{describe_trouble(summary)}.{describe_ending(summary.ended)}"
        return RunVerdict("poor", f"{moved}; {rest}")
    return _judge_motion(record, summary, stop_intervals)


def _judge_stopped_run(record: RunRecord, summary: RunSummary, fault: Fault) -> RunVerdict:
    """Make the verdict on a run that a fault stopped."""
    start_s = float(record.time_s[0]) if len(record.time_s) else 0.0
    at_s = fault.tick / summary.rate_hz - start_s
    joint = f" at {fault.joint}" if fault.joint else ""
    stopped = (
        f"Stopped by a fault after {max(at_s, 0.0):.1f} s{joint}: {end_with_full_stop(fault.cause)}"
    )
    moved = describe_distance(record, summary)
    before = ", ".join([moved[0].lower() + moved[1:], *describe_refused_commands(summary)])
    return RunVerdict(
        "bad", f"{stopped}{describe_last_control_state(record, at_s)} Before that: {before}."
    )


def _judge_joint_test(record: RunRecord, summary: RunSummary, command: str) -> RunVerdict:
    """Judge a run that tests the joints and is not meant to locomote: it is good if it moved every joint.

    A joint was moved if its target deviated by more than MIN_MOVED_RAD from the median of its targets.

    Args:
        record: The recorded run.
        summary: Summary of the run.
        command: Command that judges such a run in detail.
    """
    all_joints_moved = False
    if not len(record.target):
        words = "No joint was moved: the robot was never armed."
    else:
        deviation_rad = np.abs(record.target - np.nanmedian(record.target, axis=0))  # (n, joints)
        max_deviation_rad = np.nanmax(deviation_rad, axis=0)
        unmoved: list[str] = []
        for joint, joint_deviation_rad in zip(
            record.description.joints, max_deviation_rad, strict=True
        ):
            # False for NaN, which is a joint without any target.
            was_moved = joint_deviation_rad > MIN_MOVED_RAD
            if not was_moved:
                unmoved.append(joint.name)
        all_joints_moved = not unmoved
        if all_joints_moved:
            words = f"Every joint was moved. Judge the run with `{command} {record.path}`."
        else:
            words = f"Not moved: {', '.join(unmoved)}. Run it again with a longer --duration."
    ending = describe_ending(summary.ended)
    words = f"{words} Ran for {summary.duration_s:.1f} s; {describe_trouble(summary)}.{ending}"
    is_good = all_joints_moved and summary.ended == COMPLETE
    return RunVerdict("good" if is_good else "poor", words)


def _judge_motion(
    record: RunRecord, summary: RunSummary, stop_intervals: StopIntervals
) -> RunVerdict:
    """Judge a run that no fault stopped and whose pose is known, by the measured stop_intervals.

    The run is poor if it did not locomote, if it jammed or was stationary for long, or if it ended early or behind its
    start. The controller's own report is added to the words, also where it contradicts the measurement.

    Args:
        record: The recorded run.
        summary: Summary of the run.
        stop_intervals: Measured intervals without stop_intervals.
    """
    moved = describe_distance(record, summary)
    trouble = describe_trouble(summary)
    ending = describe_ending(summary.ended)
    if _did_not_locomote(summary):
        outcome = "Jammed" if summary.jammed else "Did not locomote"
        reason = end_with_full_stop(_explain_no_locomotion(summary))
        return RunVerdict("poor", f"{outcome}: {reason} {moved}; {trouble}.{ending}")

    pushed = describe_hand_overs(summary) or describe_pushed_obstacles(record)
    stop = find_final_stop(record, stop_intervals)
    standing_fraction = 1.0 - stop_intervals.moving_fraction
    stood_long = summary.jammed or standing_fraction > MAX_STANDING_FRACTION
    if stop is not None and not stop.is_intended and stood_long:
        outcome = "Jammed" if summary.jammed else "Stopped"
        reason = stop.reason.removeprefix("jammed: ")
        stopped = f"{outcome} at {stop.time_s:.1f} s of {get_run_end_s(record):.1f} s: {reason}"
        return RunVerdict("poor", f"{stopped} {moved}; {pushed}{trouble}.{ending}")

    still_moving = ""
    if stop is None and not ending:
        still_moving = ", and was still moving at the end"
    jam = "it jammed on the way; " if summary.jammed else ""
    stopped = ""
    if stop is not None:
        stopped = f" Locomotion ended at {stop.time_s:.1f} s of {get_run_end_s(record):.1f} s: {stop.reason}"
    contradiction = describe_contradiction(record, stop_intervals)
    words = f"{moved}{still_moving}; {pushed}{jam}{trouble}.{stopped}{contradiction}{ending}"

    ended_early = bool(ending)
    went_backward = (summary.path_distance_m or 0.0) < 0
    is_distance_unknown = get_distance_m(summary) is None
    is_poor = ended_early or went_backward or is_distance_unknown
    return RunVerdict("poor" if is_poor else "good", words)


def _did_not_locomote(summary: RunSummary) -> bool:
    """Return whether the body never moved, or only to and fro within MOVED_M."""
    if summary.locomoting_fraction == 0:
        return True
    measured = (summary.path_distance_m, summary.net_displacement_m)
    distances = [abs(distance) for distance in measured if distance is not None]
    return bool(distances) and max(distances) < MOVED_M


def _explain_no_locomotion(summary: RunSummary) -> str:
    if summary.last_state == "Locomoting":
        return "it ended less than 2 cm from where it began"
    return summary.last_reason or STANDING_STILL


def find_final_stop(record: RunRecord, stop_intervals: StopIntervals) -> LocomotionStop | None:
    """Find when the body came to rest until the end of the run, as measured, and the reason that control reported.

    Returns:
        The stop, or None if the body moved at the end, or was stationary there for less than MIN_STOP_S.
    """
    stop = stop_intervals.final_stop
    if stop is None or stop_intervals.run_end_s - stop.start_s < MIN_STOP_S:
        return None
    reported = [
        state for state in record.control_states if get_report_time_s(record, state) >= stop.start_s
    ]
    is_intended = bool(reported) and reported[-1].state == "Idle"
    return LocomotionStop(
        stop.start_s, end_with_full_stop(find_longest_reason(record, stop)), is_intended
    )

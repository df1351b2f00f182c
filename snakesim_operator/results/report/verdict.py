"""The result of a run in one sentence, and whether it is good or bad news."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_hal.model.checked import CHECK
from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.wire.messages import Fault
from snakesim_operator.results.metrics.motion import Motion, measure_motion
from snakesim_operator.results.report.phrases import (
    MOVED_M,
    as_sentence,
    describe_contradiction,
    describe_distance,
    describe_ending,
    describe_hand_overs,
    describe_last_control_state,
    describe_pushed_obstacles,
    describe_refused_commands,
    describe_trouble,
)
from snakesim_operator.results.report.timeline import longest_reason
from snakesim_operator.results.run_ending import COMPLETE
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary, distance_m, estimates_of
from snakesim_operator.results.time_axis import end_s, reported_at_s

MIN_STOP_S = 0.5  # a shorter stop at the end is not mentioned
MAX_STANDING_FRACTION = 0.5  # a run that was stationary for more of its time, up to its end, is a poor one
MOVED_RAD = 1e-3  # a joint whose target changed by less, as by rounding, was not moved
JUDGING_COMMANDS = {  # controller that does not locomote -> command that judges its run
    CHECK: "snakesim robot check",
    "identify": "snakesim robot identify",
}
Kind = Literal["good", "poor", "bad"]


@dataclass(frozen=True)
class Verdict:
    """One sentence, and how good the news is."""

    kind: Kind
    words: str


@dataclass(frozen=True)
class Stop:
    """The end of locomotion, before the end of the run."""

    at_s: float
    why: str
    on_purpose: bool


def verdict(record: RunRecord, summary: RunSummary) -> Verdict:
    """Return the result of a run in plain words, and which of its numbers are estimates."""
    measured = _judge_run(record, summary)
    estimates = "; ".join(estimates_of(summary).in_words())
    if not estimates:
        return measured
    return Verdict(measured.kind, f"{measured.words} {as_sentence(estimates.capitalize())}")


def _judge_run(record: RunRecord, summary: RunSummary) -> Verdict:
    if summary.ticks == 0 and len(record.time_s) == 0 and not summary.faults:
        return Verdict("bad", f"Nothing was recorded: the robot was never armed ({summary.ended}).")
    stopping_faults = [fault for fault in summary.faults if fault.reach == "robot"]
    if stopping_faults:
        return _judge_stopped_run(record, summary, stopping_faults[0])
    command = JUDGING_COMMANDS.get(record.config.controller)
    if command is not None:
        return _judge_joint_test(record, summary, command)
    motion = measure_motion(record)
    if motion is None:
        moved = describe_distance(record, summary)
        rest = f"{describe_hand_overs(summary)}{describe_trouble(summary)}.{describe_ending(summary.ended)}"
        return Verdict("poor", f"{moved}; {rest}")
    return _judge_motion(record, summary, motion)


def _judge_stopped_run(record: RunRecord, summary: RunSummary, fault: Fault) -> Verdict:
    """Judge a run that a fault stopped."""
    begin_s = float(record.time_s[0]) if len(record.time_s) else 0.0
    at_s = fault.tick / summary.rate_hz - begin_s
    joint = f" at {fault.joint}" if fault.joint else ""
    stopped = f"Stopped by a fault after {max(at_s, 0.0):.1f} s{joint}: {as_sentence(fault.cause)}"
    moved = describe_distance(record, summary)
    before = ", ".join([moved[0].lower() + moved[1:], *describe_refused_commands(summary)])
    return Verdict("bad", f"{stopped}{describe_last_control_state(record, at_s)} Before that: {before}.")


def _judge_joint_test(record: RunRecord, summary: RunSummary, command: str) -> Verdict:
    """Judge a run that tests the joints and is not meant to locomote: it is good if it moved every joint.

    A joint was moved if its target deviated by more than MOVED_RAD from the median of its targets.

    Args:
        record: The recorded run.
        summary: The numbers of the run.
        command: The command that judges such a run in detail.
    """
    all_joints_moved = False
    if not len(record.target):
        words = "No joint was moved: the robot was never armed."
    else:
        deviation_rad = np.abs(record.target - np.nanmedian(record.target, axis=0))  # (n, joints)
        max_deviation_rad = np.nanmax(deviation_rad, axis=0)
        unmoved: list[str] = []
        for joint, joint_deviation_rad in zip(record.description.joints, max_deviation_rad, strict=True):
            was_moved = joint_deviation_rad > MOVED_RAD  # False for NaN, which is a joint without any target
            if not was_moved:
                unmoved.append(joint.name)
        all_joints_moved = not unmoved
        if all_joints_moved:
            words = f"Every joint was moved. Judge the run with `{command} {record.folder}`."
        else:
            words = f"Not moved: {', '.join(unmoved)}. Run it again with a longer --duration."
    ending = describe_ending(summary.ended)
    words = f"{words} Ran for {summary.duration_s:.1f} s; {describe_trouble(summary)}.{ending}"
    is_good = all_joints_moved and summary.ended == COMPLETE
    return Verdict("good" if is_good else "poor", words)


def _judge_motion(record: RunRecord, summary: RunSummary, motion: Motion) -> Verdict:
    """Judge a run that no fault stopped and whose pose is known, by the measured motion.

    The run is poor if it did not locomote, if it jammed or was stationary for long, or if it ended early or behind its
    start. The controller's own report is added to the words, also where it contradicts the measurement.

    Args:
        record: The recorded run.
        summary: The numbers of the run.
        motion: When the body moved and when it stood.
    """
    moved = describe_distance(record, summary)
    trouble = describe_trouble(summary)
    ending = describe_ending(summary.ended)
    if _did_not_locomote(summary):
        outcome = "Jammed" if summary.jammed else "Did not locomote"
        reason = as_sentence(_why_not_locomoted(summary))
        return Verdict("poor", f"{outcome}: {reason} {moved}; {trouble}.{ending}")

    pushed = describe_hand_overs(summary) or describe_pushed_obstacles(record)
    stop = stop_of(record, motion)
    standing_fraction = 1.0 - motion.moving_fraction
    stood_long = summary.jammed or standing_fraction > MAX_STANDING_FRACTION
    if stop is not None and not stop.on_purpose and stood_long:
        outcome = "Jammed" if summary.jammed else "Stopped"
        reason = stop.why.removeprefix("jammed: ")
        stopped = f"{outcome} at {stop.at_s:.1f} s of {end_s(record):.1f} s: {reason}"
        return Verdict("poor", f"{stopped} {moved}; {pushed}{trouble}.{ending}")

    still_moving = ""
    if stop is None and not ending:
        still_moving = ", and was still moving at the end"
    jam = "it jammed on the way; " if summary.jammed else ""
    stopped = ""
    if stop is not None:
        stopped = f" Locomotion ended at {stop.at_s:.1f} s of {end_s(record):.1f} s: {stop.why}"
    contradiction = describe_contradiction(record, motion)
    words = f"{moved}{still_moving}; {pushed}{jam}{trouble}.{stopped}{contradiction}{ending}"

    ended_early = bool(ending)
    went_backward = (summary.path_distance_m or 0.0) < 0
    is_distance_unknown = distance_m(summary) is None
    is_poor = ended_early or went_backward or is_distance_unknown
    return Verdict("poor" if is_poor else "good", words)


def _did_not_locomote(summary: RunSummary) -> bool:
    """Return whether the body never moved, or only to and fro within MOVED_M."""
    if summary.locomoting_fraction == 0:
        return True
    measured = (summary.path_distance_m, summary.net_displacement_m)
    distances = [abs(distance) for distance in measured if distance is not None]
    return bool(distances) and max(distances) < MOVED_M


def _why_not_locomoted(summary: RunSummary) -> str:
    if summary.last_state == "Locomoting":
        return "it ended less than 2 cm from where it began"
    return summary.last_reason or STANDING_STILL


def stop_of(record: RunRecord, motion: Motion) -> Stop | None:
    """Return when the body came to rest for the rest of the run, as measured, and why, as control reported it.

    None if it moved to the end, or stood for less than MIN_STOP_S.
    """
    stop = motion.final_stop
    if stop is None or motion.end_s - stop.start_s < MIN_STOP_S:
        return None
    reported = [state for state in record.control if reported_at_s(record, state) >= stop.start_s]
    on_purpose = bool(reported) and reported[-1].state == "Idle"
    return Stop(stop.start_s, as_sentence(longest_reason(record, stop)), on_purpose)

"""The result of a run, in one sentence."""

from dataclasses import dataclass
from typing import Literal

from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_operator.results.metrics.motion import Motion, motion_of
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.purpose import purpose_of
from snakesim_operator.results.report.timeline import longest_reason, reported_while_moving
from snakesim_operator.results.run_ending import COMPLETE, UNKNOWN
from snakesim_operator.results.summary import RunSummary, distance_m, estimates_of
from snakesim_operator.results.time_axis import end_s, reported_at_s

MOVED_M = 0.02  # less than this is no locomotion
MIN_STOP_S = 0.5  # a shorter stop at the end is not worth a word
MIN_PUSH_N = 0.5  # a smaller measured force is no push
POOR_SHARE = 0.5  # a run that stood still for more of its time than this, up to its end, is no good one
SHOWN_HANDOVERS = 8
Kind = Literal["good", "poor", "bad"]


@dataclass(frozen=True)
class Verdict:
    """One sentence, and how good the news is."""

    kind: Kind
    words: str


def verdict(record: RunRecord, summary: RunSummary) -> Verdict:
    """The run in plain words, and what of it nobody measured."""
    found = _verdict(record, summary)
    estimates = "; ".join(estimates_of(summary).in_words())
    return Verdict(found.kind, f"{found.words} {_sentence(estimates.capitalize())}") if estimates else found


def _verdict(record: RunRecord, summary: RunSummary) -> Verdict:
    if summary.ticks == 0 and len(record.time_s) == 0 and not summary.faults:
        return Verdict("bad", f"Nothing was recorded: the robot was never armed ({summary.ended}).")
    moved = _moved(record, summary)
    stopping = [fault for fault in summary.faults if fault.reach == "robot"]
    if stopping:
        fault = stopping[0]
        at_s = fault.tick / summary.rate_hz - (float(record.time_s[0]) if len(record.time_s) else 0.0)
        joint = f" at {fault.joint}" if fault.joint else ""
        what = f"Stopped by a fault after {max(at_s, 0.0):.1f} s{joint}: {_sentence(fault.cause)}"
        said = _control_said(record, at_s)
        before = ", ".join([moved[0].lower() + moved[1:], *_refused(summary)])
        return Verdict("bad", f"{what}{said} Before that: {before}.")
    purpose = purpose_of(record)
    if purpose is not None:
        served, words = purpose
        said = f"{words} Ran for {summary.duration_s:.1f} s; {_trouble(summary)}.{_ending(summary.ended)}"
        return Verdict("good" if served and summary.ended == COMPLETE else "poor", said)
    motion = motion_of(record)
    if motion is None:
        rest = f"{_handed_over(record, summary)}{_trouble(summary)}.{_ending(summary.ended)}"
        return Verdict("poor", f"{moved}; {rest}")
    return _verdict_of_motion(record, summary, motion, moved)


def _verdict_of_motion(record: RunRecord, summary: RunSummary, motion: Motion, moved: str) -> Verdict:
    """Of a run without a fault, whose pose is known: by the measured motion, and beside it what control reported."""
    trouble = _trouble(summary)
    ending = _ending(summary.ended)
    handed_over = _handed_over(record, summary) or _pushed_off(record)
    if _did_not_locomote(summary):
        kind = "Jammed" if summary.jammed else "Did not locomote"
        came_back = summary.last_state == "Locomoting"
        why = "it ended less than 2 cm from where it began" if came_back else summary.last_reason or STANDING_STILL
        return Verdict("poor", f"{kind}: {_sentence(why)} {moved}; {trouble}.{ending}")
    stop = stop_of(record, motion)
    stood = 1.0 - motion.moving_fraction
    if stop is not None and not stop.on_purpose and (summary.jammed or stood > POOR_SHARE):
        kind = "Jammed" if summary.jammed else "Stopped"
        said = f"{kind} at {stop.at_s:.1f} s of {end_s(record):.1f} s: {stop.why.removeprefix('jammed: ')}"
        return Verdict("poor", f"{said} {moved}; {handed_over}{trouble}.{ending}")
    jam = "it jammed on the way; " if summary.jammed else ""
    until_end = ", and was still moving at the end" if stop is None and not ending else ""
    stopped = "" if stop is None else f" Locomotion ended at {stop.at_s:.1f} s of {end_s(record):.1f} s: {stop.why}"
    contradiction = _reported_while_moving(record, motion)
    backward = (summary.path_distance_m or 0.0) < 0
    is_poor = bool(ending) or backward or distance_m(summary) is None
    good: Kind = "poor" if is_poor else "good"
    return Verdict(good, f"{moved}{until_end}; {handed_over}{jam}{trouble}.{stopped}{contradiction}{ending}")


def _did_not_locomote(summary: RunSummary) -> bool:
    """Whether it never moved, or only to and fro by next to nothing."""
    if summary.locomoting_fraction == 0:
        return True
    distances = [abs(one) for one in (summary.path_distance_m, summary.net_displacement_m) if one is not None]
    return bool(distances) and max(distances) < MOVED_M


def _reported_while_moving(record: RunRecord, motion: Motion) -> str:
    """What control reported of standing while the body moved, as its report."""
    found = reported_while_moving(record, motion)
    if found is None:
        return ""
    reason = found.reason.strip().rstrip(".;")
    return f' For {found.lasted_s:.1f} s of its motion control reported "{reason}".'


def _pushed_off(record: RunRecord) -> str:
    """How many obstacles it pushed off, of those that its controller chose and where a contact was measured."""
    obstacles: set[str] = set()
    for state in record.control:
        for point, measured_n in zip(state.push_points, state.measured_force_n, strict=False):
            if point.obstacle is not None and measured_n is not None and measured_n >= MIN_PUSH_N:
                obstacles.add(point.obstacle)
    if not obstacles:
        return ""
    return f"pushed off {len(obstacles)} {'obstacle' if len(obstacles) == 1 else 'obstacles'}; "


def _ending(ended: str) -> str:
    if ended == COMPLETE:
        return ""
    if ended.startswith(UNKNOWN):
        return f" How the run ended is not known: {_sentence(ended.removeprefix(UNKNOWN))}"
    return f" The run ended early: {_sentence(ended)}"


def _trouble(summary: RunSummary) -> str:
    """What went wrong, and stopped nothing: joints lost, other faults, commands refused."""
    lost = list(dict.fromkeys(fault.joint for fault in summary.faults if fault.joint and fault.reach == "joint"))
    others = [fault for fault in summary.faults if fault.reach == "none"]
    said = [f"went on without {', '.join(lost)}"] if lost else []
    if others:
        said.append(f"{'a fault' if len(others) == 1 else f'{len(others)} faults'} ({_sentence(others[0].cause)[:-1]})")
    return ", ".join([*(said or ["no fault"]), *_refused(summary)])


def _refused(summary: RunSummary) -> list[str]:
    reasons = {reason: count for reason, count in summary.rejected_commands.items() if count}
    count = sum(reasons.values())
    return [f"{count} {'command' if count == 1 else 'commands'} refused ({', '.join(reasons)})"] if reasons else []


def _moved(record: RunRecord, summary: RunSummary) -> str:
    duration = f"in {summary.duration_s:.1f} s"
    if summary.path_distance_m is not None:
        back = " backward" if summary.path_distance_m <= -MOVED_M else ""
        return f"Moved {abs(summary.path_distance_m):.2f} m{back} along the path {duration}"
    if summary.net_displacement_m is not None:
        return f"Moved {summary.net_displacement_m:.2f} m {duration}"
    blind = ", because the robot has no pose sensor" if record.config.robot.sensors.pose is None else ""
    return f"Ran for {summary.duration_s:.1f} s; the distance is unknown{blind}"


def _handed_over(record: RunRecord, summary: RunSummary) -> str:
    names = summary.propulsion_joints
    if not names:
        return ""
    if len(names) == 1:
        return f"{names[0]} propelled throughout; "
    if len(names) <= SHOWN_HANDOVERS:
        return f"propulsion handed over {' → '.join(names)}; "
    shown = " → ".join([*names[:4], "…", names[-1]])
    return f"propulsion handed over {summary.hand_overs} times among {len(set(names))} joints ({shown}); "


def _control_said(record: RunRecord, at_s: float) -> str:
    """What control lacked when the robot was stopped: a fault of the lease only shows that no command came."""
    states = [state for state in record.control if reported_at_s(record, state) <= at_s]
    return f" Control said: {_sentence(states[-1].reason)}" if states and states[-1].state == "NotLocomoting" else ""


@dataclass(frozen=True)
class Stop:
    """The end of locomotion, before that of the run."""

    at_s: float
    why: str
    on_purpose: bool


def stop_of(record: RunRecord, motion: Motion) -> Stop | None:
    """When the body came to rest for the rest of the run, as measured, and why, as far as control reported it.

    None when it moved to the end, or stood for so short a time that it is not worth a word.
    """
    stop = motion.final_stop
    if stop is None or motion.end_s - stop.start_s < MIN_STOP_S:
        return None
    reported = [state for state in record.control if reported_at_s(record, state) >= stop.start_s]
    on_purpose = bool(reported) and reported[-1].state == "Idle"
    return Stop(stop.start_s, _sentence(longest_reason(record, stop)), on_purpose)


def _sentence(words: str) -> str:
    words = words.strip().rstrip(".;")
    return f"{words}." if words else ""

"""The result of a run, in one sentence."""

from dataclasses import dataclass
from typing import Literal

from snakesim_operator.results.ended import COMPLETE, UNKNOWN
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.purpose import purpose_of
from snakesim_operator.results.report.timeline import (
    came_to_rest_s,
    end_s,
    propulsion_intervals,
    reported_at_s,
    state_bands,
)
from snakesim_operator.results.summary import RunSummary, distance_m, estimates_of

MOVED_M = 0.02  # less than this is no locomotion
MIN_STOP_S = 0.5  # a shorter stop at the end is not worth a word
RESTING_SHARE = 0.02  # of all its way: what is so near to the end of it has arrived, but for who moves to the last,
REST_SHARE, REST_S = 0.1, 5.0  # which differs from a rest by how long it takes: a tenth of the run, or so many seconds
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
    trouble = _trouble(summary)
    ending = _ending(summary.ended)
    distance = distance_m(summary)
    if distance is None:
        return Verdict("poor", f"{moved}; {_handed_over(record, summary)}{trouble}.{ending}")
    if abs(distance) < MOVED_M or summary.locomoting_fraction == 0:
        why = summary.last_reason or "the controller gave no reason"
        if summary.last_state == "Locomoting":
            why = "the snake stayed where it was, although its controller reported Locomoting"
        kind = "Jammed" if summary.jammed else "Did not locomote"
        return Verdict("poor", f"{kind}: {_sentence(why)} {moved}; {trouble}.{ending}")
    stop = stop_of(record, abs(distance))
    stopped = "" if stop is None else f" Locomotion ended at {stop.at_s:.1f} s of {end_s(record):.1f} s: {stop.why}"
    if stop is not None and not stop.on_purpose and (summary.jammed or stop.share > POOR_SHARE):
        kind = "Jammed" if summary.jammed else "Stopped"
        said = f"{kind} at {stop.at_s:.1f} s of {end_s(record):.1f} s: {stop.why.removeprefix('jammed: ')}"
        return Verdict("poor", f"{said} {moved}; {_handed_over(record, summary)}{trouble}.{ending}")
    jam = "it jammed on the way; " if summary.jammed else ""
    good: Kind = "poor" if ending or distance < 0 else "good"
    return Verdict(good, f"{moved}; {_handed_over(record, summary)}{jam}{trouble}.{stopped}{ending}")


def _ending(ended: str) -> str:
    if ended == COMPLETE:
        return ""
    if ended.startswith(UNKNOWN):
        return f" How the run ended is not known: {_sentence(ended.removeprefix(UNKNOWN))}"
    return f" The run ended early: {_sentence(ended)}"


def _trouble(summary: RunSummary) -> str:
    """What went wrong, and stopped nothing: joints lost, other faults, commands refused."""
    lost = list(dict.fromkeys(fault.joint for fault in summary.faults if fault.joint is not None))
    others = [fault for fault in summary.faults if fault.joint is None]
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
    distinct = len({one.joint for one in propulsion_intervals(record)})
    shown = " → ".join([*names[:4], "…", names[-1]])
    return f"propulsion handed over {len(names) - 1} times among {distinct} joints ({shown}); "


def _control_said(record: RunRecord, at_s: float) -> str:
    """What control lacked when the robot was stopped: a fault of the lease only shows that no command came."""
    states = [state for state in record.control if reported_at_s(record, state) <= at_s]
    return f" Control said: {_sentence(states[-1].reason)}" if states and states[-1].state == "NotLocomoting" else ""


@dataclass(frozen=True)
class Stop:
    """The end of locomotion, before that of the run."""

    at_s: float
    share: float  # of the run that it stood still for then
    why: str
    on_purpose: bool


def stop_of(record: RunRecord, moved_m: float) -> Stop | None:
    """When and why it came to rest, by what control reported and by what was measured; None when it did not."""
    bands, end = state_bands(record), end_s(record)
    at_s = bands[-1].start_s if len(bands) > 1 and bands[-1].what != "Locomoting" else end
    rest_s = came_to_rest_s(record, min(MOVED_M, RESTING_SHARE * moved_m))
    if rest_s is not None and at_s - rest_s > max(MIN_STOP_S, min(REST_SHARE * end, REST_S)):
        at_s = rest_s
    if end - at_s < MIN_STOP_S:
        return None
    after = [state for state in record.control if reported_at_s(record, state) >= at_s and state.state != "Locomoting"]
    why = after[0].reason if after else "its controller reported Locomoting all the same"
    return Stop(at_s, (end - at_s) / end, _sentence(why), bool(after) and after[-1].state == "Idle")


def _sentence(words: str) -> str:
    words = words.strip().rstrip(".;")
    return f"{words}." if words else ""

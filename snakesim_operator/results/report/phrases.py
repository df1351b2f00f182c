"""Describes parts of a run for the sentence of its verdict: distance, hand-overs, trouble, and ending.

A phrase that is part of a longer sentence ends with its own separator; without anything to describe it is empty.
"""

from snakesim_operator.results.metrics.motion import StopIntervals
from snakesim_operator.results.report.timeline import find_false_not_locomoting_reports
from snakesim_operator.results.run_ending import COMPLETE, UNKNOWN_PREFIX
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.results.time_axis import get_report_time_s

MOVED_M = 0.02  # a body that moved less did not locomote
MIN_PUSH_N = 0.5  # a smaller measured force does not count as a push
MAX_HAND_OVERS_NAMED = 8


def end_with_full_stop(words: str) -> str:
    """End a text with exactly one full stop; an empty text stays empty."""
    words = words.strip().rstrip(".;")
    return f"{words}." if words else ""


def describe_distance(record: RunRecord, summary: RunSummary) -> str:
    """Describe how far the body moved in which time, or why the distance is unknown."""
    duration = f"in {summary.duration_s:.1f} s"
    if summary.path_distance_m is not None:
        back = " backward" if summary.path_distance_m <= -MOVED_M else ""
        return f"Moved {abs(summary.path_distance_m):.2f} m{back} along the path {duration}"
    if summary.net_displacement_m is not None:
        return f"Moved {summary.net_displacement_m:.2f} m {duration}"
    reason = (
        ", because the robot has no pose sensor" if record.config.robot.sensors.pose is None else ""
    )
    return f"Ran for {summary.duration_s:.1f} s; the distance is unknown{reason}"


def describe_hand_overs(summary: RunSummary) -> str:
    """Describe which joints propelled, one after another; empty if none is known."""
    names = summary.propulsion_joints
    if not names:
        return ""
    if len(names) == 1:
        return f"{names[0]} propelled throughout; "
    if len(names) <= MAX_HAND_OVERS_NAMED:
        return f"propulsion handed over {' → '.join(names)}; "
    shown = " → ".join([*names[:4], "…", names[-1]])
    return f"propulsion handed over {summary.hand_overs} times among {len(set(names))} joints ({shown}); "


def describe_pushed_obstacles(record: RunRecord) -> str:
    """Describe how many obstacles the body pushed off: those of push-points with a measured contact force."""
    obstacles: set[str] = set()
    for state in record.control_states:
        for point, measured_n in zip(state.push_points, state.measured_force_n, strict=False):
            if point.obstacle is not None and measured_n is not None and measured_n >= MIN_PUSH_N:
                obstacles.add(point.obstacle)
    if not obstacles:
        return ""
    noun = "obstacle" if len(obstacles) == 1 else "obstacles"
    return f"pushed off {len(obstacles)} {noun}; "


def describe_trouble(summary: RunSummary) -> str:
    """Describe problems that did not stop the run: lost joints, other faults, refused commands."""
    phrases: list[str] = []
    lost_joints: list[str] = []
    for fault in summary.faults:
        if fault.joint and fault.scope == "joint" and fault.joint not in lost_joints:
            lost_joints.append(fault.joint)
    if lost_joints:
        phrases.append(f"went on without {', '.join(lost_joints)}")
    other_faults = [fault for fault in summary.faults if fault.scope == "none"]
    if other_faults:
        count = "a fault" if len(other_faults) == 1 else f"{len(other_faults)} faults"
        cause = end_with_full_stop(other_faults[0].cause)[:-1]
        phrases.append(f"{count} ({cause})")
    if not phrases:
        phrases.append("no fault")
    return ", ".join([*phrases, *describe_refused_commands(summary)])


def describe_refused_commands(summary: RunSummary) -> list[str]:
    """Describe by a phrase the commands that the limiter refused; an empty list if it refused none."""
    counts = {reason: count for reason, count in summary.rejected_commands.items() if count}
    if not counts:
        return []
    total = sum(counts.values())
    noun = "command" if total == 1 else "commands"
    return [f"{total} {noun} refused ({', '.join(counts)})"]


def describe_ending(ended: str) -> str:
    """Describe how an incomplete run ended; empty if the run is complete."""
    if ended == COMPLETE:
        return ""
    if ended.startswith(UNKNOWN_PREFIX):
        return f" How the run ended is not known: {end_with_full_stop(ended.removeprefix(UNKNOWN_PREFIX))}"
    return f" The run ended early: {end_with_full_stop(ended)}"


def describe_contradiction(record: RunRecord, motion: StopIntervals) -> str:
    """Describe for how long control reported no motion while the body moved; empty if it did not for long."""
    mismatch = find_false_not_locomoting_reports(record, motion)
    if mismatch is None:
        return ""
    reason = mismatch.reason.strip().rstrip(".;")
    return f' For {mismatch.duration_s:.1f} s of its motion control reported "{reason}".'


def describe_last_control_state(record: RunRecord, at_s: float) -> str:
    """Describe why the controller did not locomote when a fault stopped the robot; empty if it did.

    An expired lease alone only shows that no command arrived.

    Args:
        record: The recorded run.
        at_s: Time of the fault on the time axis.
    """
    states = [state for state in record.control_states if get_report_time_s(record, state) <= at_s]
    if not states or states[-1].state != "NotLocomoting":
        return ""
    return f" Control reported: {end_with_full_stop(states[-1].reason)}"

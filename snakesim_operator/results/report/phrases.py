"""The parts of a verdict's sentence: distance, hand-overs, trouble, and how the run ended.

A phrase that is part of a longer sentence ends with its own separator; without anything to describe it is empty.
"""

from snakesim_operator.results.metrics.motion import Motion
from snakesim_operator.results.report.timeline import reported_while_moving
from snakesim_operator.results.run_ending import COMPLETE, UNKNOWN
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.results.time_axis import reported_at_s

MOVED_M = 0.02  # a body that moved less did not locomote
MIN_PUSH_N = 0.5  # a smaller measured force is no push
MAX_HAND_OVERS_NAMED = 8


def as_sentence(words: str) -> str:
    """Return the words with exactly one full stop at the end."""
    words = words.strip().rstrip(".;")
    return f"{words}." if words else ""


def describe_distance(record: RunRecord, summary: RunSummary) -> str:
    """Describe how far the body moved, and in which time."""
    duration = f"in {summary.duration_s:.1f} s"
    if summary.path_distance_m is not None:
        back = " backward" if summary.path_distance_m <= -MOVED_M else ""
        return f"Moved {abs(summary.path_distance_m):.2f} m{back} along the path {duration}"
    if summary.net_displacement_m is not None:
        return f"Moved {summary.net_displacement_m:.2f} m {duration}"
    reason = ", because the robot has no pose sensor" if record.config.robot.sensors.pose is None else ""
    return f"Ran for {summary.duration_s:.1f} s; the distance is unknown{reason}"


def describe_hand_overs(summary: RunSummary) -> str:
    """Describe which joints propelled, one after the other."""
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
    """Describe how many obstacles the body pushed off: chosen by the controller, with a measured contact."""
    obstacles: set[str] = set()
    for state in record.control:
        for point, measured_n in zip(state.push_points, state.measured_force_n, strict=False):
            if point.obstacle is not None and measured_n is not None and measured_n >= MIN_PUSH_N:
                obstacles.add(point.obstacle)
    if not obstacles:
        return ""
    noun = "obstacle" if len(obstacles) == 1 else "obstacles"
    return f"pushed off {len(obstacles)} {noun}; "


def describe_trouble(summary: RunSummary) -> str:
    """Describe what went wrong without stopping the run: lost joints, other faults, refused commands."""
    phrases: list[str] = []
    lost_joints: list[str] = []
    for fault in summary.faults:
        if fault.joint and fault.reach == "joint" and fault.joint not in lost_joints:
            lost_joints.append(fault.joint)
    if lost_joints:
        phrases.append(f"went on without {', '.join(lost_joints)}")
    other_faults = [fault for fault in summary.faults if fault.reach == "none"]
    if other_faults:
        count = "a fault" if len(other_faults) == 1 else f"{len(other_faults)} faults"
        cause = as_sentence(other_faults[0].cause)[:-1]
        phrases.append(f"{count} ({cause})")
    if not phrases:
        phrases.append("no fault")
    return ", ".join([*phrases, *describe_refused_commands(summary)])


def describe_refused_commands(summary: RunSummary) -> list[str]:
    """Return a phrase about the commands that the limiter refused; empty if it refused none."""
    counts = {reason: count for reason, count in summary.rejected_commands.items() if count}
    if not counts:
        return []
    total = sum(counts.values())
    noun = "command" if total == 1 else "commands"
    return [f"{total} {noun} refused ({', '.join(counts)})"]


def describe_ending(ended: str) -> str:
    """Describe how a run ended that was not complete."""
    if ended == COMPLETE:
        return ""
    if ended.startswith(UNKNOWN):
        return f" How the run ended is not known: {as_sentence(ended.removeprefix(UNKNOWN))}"
    return f" The run ended early: {as_sentence(ended)}"


def describe_contradiction(record: RunRecord, motion: Motion) -> str:
    """Describe what control reported as a reason for no motion while the body moved."""
    mismatch = reported_while_moving(record, motion)
    if mismatch is None:
        return ""
    reason = mismatch.reason.strip().rstrip(".;")
    return f' For {mismatch.lasted_s:.1f} s of its motion control reported "{reason}".'


def describe_last_control_state(record: RunRecord, at_s: float) -> str:
    """Describe what control was missing when a fault stopped the robot.

    A fault of the lease alone only shows that no command came.
    """
    states = [state for state in record.control if reported_at_s(record, state) <= at_s]
    if not states or states[-1].state != "NotLocomoting":
        return ""
    return f" Control reported: {as_sentence(states[-1].reason)}"

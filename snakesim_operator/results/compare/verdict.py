"""Describes the result of a comparison in a few sentences, for the end of the table and the top of the page."""

from dataclasses import dataclass

from snakesim_operator.results.compare.difference import (
    DIVERGENCE_THRESHOLD_RAD,
    STATIONARY_THRESHOLD_M,
    AdvanceComparison,
    RunDifference,
)

SAME_TEXT = "the same"


@dataclass(frozen=True)
class ToleranceCheck:
    """Result of the option `--within`: the tolerance in percent, and whether the distances are within it."""

    percent: float
    holds: bool
    words: str


def check_tolerance(difference: RunDifference, percent: float) -> ToleranceCheck | None:
    """Check whether the distance of B differs from that of A by at most a percentage.

    Returns:
        The result, or None if a distance is unknown.
    """
    advance = difference.advance
    if advance is None:
        return None
    actual_percent = advance.percent
    if actual_percent is None:
        words = f"A did not move and B moved {advance.b_m:.3f} m, which is more than any percentage"
        return ToleranceCheck(percent, False, f"not within {percent:g} %: {words}")
    holds = abs(actual_percent) <= percent
    result = "within" if holds else "not within"
    return ToleranceCheck(
        percent, holds, f"{result} {percent:g} %: {describe_relative_distance(advance)}"
    )


def describe_difference(difference: RunDifference) -> list[str]:
    """Describe by sentences how far the runs moved, when they diverged, and which joints propelled."""
    partial = _describe_partial(difference)
    if difference.is_identical:
        how_long = "in what both records hold:" if partial else "for all of their"
        return [
            *partial,
            f"The runs are the same, joint by joint, {how_long} {_describe_common_times(difference)}.",
        ]
    words = [*partial, *_describe_unknown(difference), *_describe_replays(difference)]
    if difference.advance is None:
        words.append(
            "How far they moved cannot be compared: there is no measure of it that both runs have."
        )
    else:
        words.append(f"{_capitalize(describe_distances(difference.advance))}.")
    words.append(_describe_divergence(difference))
    hand_overs = difference.hand_overs
    if hand_overs.a or hand_overs.b or hand_overs.unknown_reason:
        words.append(f"{_capitalize(describe_propulsion_order(difference))}.")
    return words


def _describe_replays(difference: RunDifference) -> list[str]:
    words: list[str] = []
    for run, record in (("A", difference.a), ("B", difference.b)):
        if record.replay_of:
            words.append(
                f"{run} is a replay: its robot moves as in {record.replay_of}, whatever its services command. Only the "
                "commands can differ."
            )
    return words


def _describe_divergence(difference: RunDifference) -> str:
    divergence = difference.divergence
    if divergence is None:
        return f"No joint's angles were ever more than {DIVERGENCE_THRESHOLD_RAD:g} rad apart."
    joint = difference.joints[divergence.joint]
    return (
        f"The runs diverge at {divergence.time_s:.2f} s, when {joint} is first more than "
        f"{DIVERGENCE_THRESHOLD_RAD:g} rad apart."
    )


def _describe_partial(difference: RunDifference) -> list[str]:
    """Describe by a sentence which records are incomplete; empty if both are complete."""
    incomplete = [
        run for run, record in (("A", difference.a), ("B", difference.b)) if record.missing
    ]
    if not incomplete:
        return []
    incomplete_runs = "A and B" if len(incomplete) == 2 else incomplete[0]
    return [
        f"Only a part of the runs is compared, because the record of {incomplete_runs} is incomplete."
    ]


def _describe_unknown(difference: RunDifference) -> list[str]:
    unknown = [
        f"{gap.quantity} {100 * gap.unknown_fraction:.2g} %"
        for gap in difference.quantities
        if gap.unknown_fraction
    ]
    if not unknown:
        return []
    return [f"Not a number in one run or in both, so it cannot be compared: {', '.join(unknown)}."]


def describe_distances(advance: AdvanceComparison) -> str:
    """Describe the distances of both runs, and that of B relative to that of A."""
    moved = f"A moved {advance.a_m:.3f} m, B {advance.b_m:.3f} m"
    if advance.percent is None:
        return f"{moved}; A did not move"
    if max(abs(advance.a_m), abs(advance.b_m)) < STATIONARY_THRESHOLD_M:
        return f"{moved}; neither moved"
    return f"{moved}: {describe_relative_distance(advance)}"


def describe_relative_distance(advance: AdvanceComparison) -> str:
    """Describe the distance of B relative to that of A, such as `B 1.6 % less`."""
    if advance.percent is None:
        return "A did not move"
    magnitude = f"{abs(advance.percent):.1f}"
    if magnitude == "0.0":
        return SAME_TEXT
    return f"B {magnitude} % {'more' if advance.percent > 0 else 'less'}"


def describe_propulsion_order(difference: RunDifference) -> str:
    """Describe whether propulsion was handed over in the same order, and if not, where the order diverges."""
    hand_overs = difference.hand_overs
    if hand_overs.unknown_reason:
        return f"which joints propelled in both is {hand_overs.unknown_reason}"
    if hand_overs.has_same_order:
        return f"propulsion is handed over in the same order, {len(hand_overs.a)} joints one after another"
    common_count = hand_overs.common_count
    next_joints: list[str] = []
    for run, periods in (("A", hand_overs.a), ("B", hand_overs.b)):
        if common_count < len(periods):
            name = difference.joints[periods[common_count].joint_index]
            next_joints.append(
                f"{run} continues with {name} at {periods[common_count].start_s:.2f} s"
            )
        else:
            next_joints.append(f"{run} with none")
    return f"the order of propulsion agrees for the first {common_count}; then {', '.join(next_joints)}"


def _describe_common_times(difference: RunDifference) -> str:
    count = len(difference.aligned.time_s)
    return (
        f"{count} common ticks"
        if difference.aligned.sampling_description == "tick by tick"
        else f"{count} common times"
    )


def _capitalize(words: str) -> str:
    return words[:1].upper() + words[1:]

"""The result of a comparison, in a few sentences: for the end of the table and the top of the page."""

from dataclasses import dataclass

from snakesim_operator.results.compare.difference import APART_RAD, STOOD_M, Advance, Difference

SAME = "the same"


@dataclass(frozen=True)
class ToleranceCheck:
    """The tolerance of `--within`, and whether it holds."""

    percent: float
    holds: bool
    words: str


def within(difference: Difference, percent: float) -> ToleranceCheck | None:
    """Check whether the distance differs by no more than a percentage of A's; None if the distance is unknown."""
    advance = difference.advance
    if advance is None:
        return None
    actual_percent = advance.percent
    if actual_percent is None:
        words = f"A did not move and B moved {advance.b_m:.3f} m, which is more than any percentage"
        return ToleranceCheck(percent, False, f"not within {percent:g} %: {words}")
    holds = abs(actual_percent) <= percent
    result = "within" if holds else "not within"
    return ToleranceCheck(percent, holds, f"{result} {percent:g} %: {relation(advance)}")


def sentences(difference: Difference) -> list[str]:
    """Return how far the runs moved, when they diverged, and which joints propelled."""
    partial = _describe_partial(difference)
    if difference.identical:
        how_long = "in what both records hold:" if partial else "for all of their"
        return [*partial, f"The runs are the same, joint by joint, {how_long} {_common(difference)}."]
    words = [*partial, *_describe_unknown(difference), *_describe_replays(difference)]
    if difference.advance is None:
        words.append("How far they moved cannot be compared: there is no measure of it that both runs have.")
    else:
        words.append(f"{_capitalize(how_far(difference.advance))}.")
    words.append(_describe_divergence(difference))
    hand_overs = difference.hand_overs
    if hand_overs.a or hand_overs.b or hand_overs.unknown:
        words.append(f"{_capitalize(who_propelled(difference))}.")
    return words


def _describe_replays(difference: Difference) -> list[str]:
    words: list[str] = []
    for run, record in (("A", difference.a), ("B", difference.b)):
        if record.replay_of:
            words.append(
                f"{run} is a replay: its robot moves as in {record.replay_of}, whatever its services command. Only the "
                "commands can differ."
            )
    return words


def _describe_divergence(difference: Difference) -> str:
    divergence = difference.divergence
    if divergence is None:
        return f"No joint's angles were ever more than {APART_RAD:g} rad apart."
    joint = difference.joints[divergence.joint]
    return f"The runs diverge at {divergence.time_s:.2f} s, when {joint} is first more than {APART_RAD:g} rad apart."


def _describe_partial(difference: Difference) -> list[str]:
    """Return a sentence if a record is incomplete, so that only a part of the runs is compared."""
    incomplete = [run for run, record in (("A", difference.a), ("B", difference.b)) if record.missing]
    if not incomplete:
        return []
    who = "A and B" if len(incomplete) == 2 else incomplete[0]
    return [f"Only a part of the runs is compared, because the record of {who} is incomplete."]


def _describe_unknown(difference: Difference) -> list[str]:
    unknown = [f"{gap.what} {100 * gap.unknown_fraction:.2g} %" for gap in difference.gaps if gap.unknown_fraction]
    if not unknown:
        return []
    return [f"Not a number in one run or in both, so it cannot be compared: {', '.join(unknown)}."]


def how_far(advance: Advance) -> str:
    """Return both distances, and B's relative to A's."""
    moved = f"A moved {advance.a_m:.3f} m, B {advance.b_m:.3f} m"
    if advance.percent is None:
        return f"{moved}; A did not move"
    if max(abs(advance.a_m), abs(advance.b_m)) < STOOD_M:
        return f"{moved}; neither moved"
    return f"{moved}: {relation(advance)}"


def relation(advance: Advance) -> str:
    """Return B's distance relative to A's, such as `B 1.6 % less`."""
    if advance.percent is None:
        return "A did not move"
    size = f"{abs(advance.percent):.1f}"
    if size == "0.0":
        return SAME
    return f"B {size} % {'more' if advance.percent > 0 else 'less'}"


def who_propelled(difference: Difference) -> str:
    """Return whether propulsion was handed over in the same order, and if not, where the order diverges."""
    hand_overs = difference.hand_overs
    if hand_overs.unknown:
        return f"which joints propelled in both is {hand_overs.unknown}"
    if hand_overs.same_order:
        return f"propulsion is handed over in the same order, {len(hand_overs.a)} joints one after another"
    agreed = hand_overs.common_count
    next_joints: list[str] = []
    for run, periods in (("A", hand_overs.a), ("B", hand_overs.b)):
        if agreed < len(periods):
            name = difference.joints[periods[agreed].joint]
            next_joints.append(f"{run} continues with {name} at {periods[agreed].start_s:.2f} s")
        else:
            next_joints.append(f"{run} with none")
    return f"the order of propulsion agrees for the first {agreed}; then {', '.join(next_joints)}"


def _common(difference: Difference) -> str:
    count = len(difference.aligned.time_s)
    return f"{count} common ticks" if difference.aligned.how == "tick by tick" else f"{count} common times"


def _capitalize(words: str) -> str:
    return words[:1].upper() + words[1:]

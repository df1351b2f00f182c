"""The result of a comparison, in a few sentences: for the end of the table and the top of the page."""

from dataclasses import dataclass

from snakesim_operator.results.compare.difference import APART_RAD, STOOD_M, Advance, Difference

SAME = "the same"


@dataclass(frozen=True)
class ToleranceCheck:
    """What `--within` asked for, and whether it holds."""

    percent: float
    holds: bool
    words: str


def within(difference: Difference, percent: float) -> ToleranceCheck | None:
    """Whether the distance differs by no more than so many per cent of A's; None when the distance is unknown."""
    advance = difference.advance
    if advance is None:
        return None
    found = advance.percent
    if found is None:
        words = f"A stood still and B moved {advance.b_m:.3f} m, which is more than any percentage"
        return ToleranceCheck(percent, False, f"not within {percent:g} %: {words}")
    holds = abs(found) <= percent
    return ToleranceCheck(percent, holds, f"{'within' if holds else 'not within'} {percent:g} %: {relation(advance)}")


def sentences(difference: Difference) -> list[str]:
    """How far, since when apart, and who propelled."""
    partial = _partial(difference)
    if difference.identical:
        how_long = "in what both records hold:" if partial else "for all of their"
        return [*partial, f"The runs are the same, joint by joint, {how_long} {_common(difference)}."]
    advance = difference.advance
    said = [*partial, *_unknown_fractions(difference)]
    for run, record in (("A", difference.a), ("B", difference.b)):
        if record.replay_of:
            said.append(
                f"{run} is a replay: its robot moves as in {record.replay_of}, whatever its services command. Only the "
                "commands can differ."
            )
    said += [
        "How far they moved cannot be compared: there is no measure of it that both runs have."
        if advance is None
        else f"{_capital(how_far(advance))}."
    ]
    parted = difference.parted
    if parted is None:
        said.append(f"No joint's angles were ever more than {APART_RAD:g} rad apart.")
    else:
        joint = difference.joints[parted.joint]
        said.append(
            f"The runs diverge at {parted.time_s:.2f} s, when {joint} is first more than {APART_RAD:g} rad apart."
        )
    hand_overs = difference.hand_overs
    if hand_overs.a or hand_overs.b or hand_overs.unknown:
        said.append(f"{_capital(who_propelled(difference))}.")
    return said


def _partial(difference: Difference) -> list[str]:
    """That not all of the runs is compared, where a record lacks something."""
    lacking = [run for run, record in (("A", difference.a), ("B", difference.b)) if record.lacks]
    if not lacking:
        return []
    who = "A and B" if len(lacking) == 2 else lacking[0]
    return [f"Only a part of the runs is compared, because the record of {who} is incomplete."]


def _unknown_fractions(difference: Difference) -> list[str]:
    unknown = [f"{gap.what} {100 * gap.unknown_fraction:.2g} %" for gap in difference.gaps if gap.unknown_fraction]
    if not unknown:
        return []
    return [f"Not a number in one run or in both, so it cannot be compared: {', '.join(unknown)}."]


def how_far(advance: Advance) -> str:
    """Both distances, and B's relative to A's."""
    moved = f"A moved {advance.a_m:.3f} m, B {advance.b_m:.3f} m"
    if advance.percent is None:
        return f"{moved}; A stood still"
    if max(abs(advance.a_m), abs(advance.b_m)) < STOOD_M:
        return f"{moved}; both stood still"
    return f"{moved}: {relation(advance)}"


def relation(advance: Advance) -> str:
    """B relative to A, such as `B 1.6 % less`."""
    if advance.percent is None:
        return "A stood still"
    size = f"{abs(advance.percent):.1f}"
    if size == "0.0":
        return SAME
    return f"B {size} % {'more' if advance.percent > 0 else 'less'}"


def who_propelled(difference: Difference) -> str:
    """Whether propulsion was handed over in the same order, and if not, from where on."""
    both, names = difference.hand_overs, difference.joints
    if both.unknown:
        return f"which joints propelled in both is {both.unknown}"
    if both.same_order:
        return f"propulsion is handed over in the same order, {len(both.a)} joints one after another"
    next_ones = [
        f"{run} goes on with {names[taken[both.agreed].joint]} at {taken[both.agreed].start_s:.2f} s"
        if both.agreed < len(taken)
        else f"{run} with none"
        for run, taken in (("A", both.a), ("B", both.b))
    ]
    return f"the order of propulsion agrees for the first {both.agreed}; then {', '.join(next_ones)}"


def _common(difference: Difference) -> str:
    count = len(difference.aligned.time_s)
    return f"{count} common ticks" if difference.aligned.how == "tick by tick" else f"{count} common instants"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]

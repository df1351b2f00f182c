"""The comparison as one page that needs no network, no program and no other file; it looks like a run's report."""

from itertools import zip_longest
from pathlib import Path

import numpy as np

from snakesim_operator.results.compare import figures
from snakesim_operator.results.compare.difference import APART_RAD, Difference
from snakesim_operator.results.compare.verdict import ToleranceCheck, sentences, who_propelled
from snakesim_operator.results.page.html import render, shown

UNKNOWN = "–"
HAND_OVERS_SHOWN = 40


def page(difference: Difference, tolerance_check: ToleranceCheck | None = None) -> str:
    """Return the page that compares two runs, as HTML.

    Args:
        difference: The comparison of the runs A and B.
        tolerance_check: The result of the option `--within`; None if the option is not set.
    """
    verdict = sentences(difference)
    verdict_class = ""  # CSS class that colors the verdict; empty without a tolerance
    if tolerance_check is not None:
        check_sentence = f"{tolerance_check.words[:1].upper()}{tolerance_check.words[1:]}."
        verdict = [*verdict, check_sentence]
        verdict_class = "good" if tolerance_check.holds else "bad"
    records = (difference.a, difference.b)
    hand_over_rows = list(zip_longest(difference.hand_overs.a, difference.hand_overs.b))
    return render(
        Path(__file__).parent / "compare.html",
        len(difference.joints),
        title=" and ".join(record.folder.name for record in records),
        difference=difference,
        apart_rad=APART_RAD,
        records=records,
        kind=verdict_class,
        verdict=" ".join(verdict),
        maps=[("Angles", difference.angle), ("Torques", difference.torque)],
        figures=figures,
        worst=_worst(difference),
        who_propelled=who_propelled(difference),
        turns=hand_over_rows[:HAND_OVERS_SHOWN],
        more_turns=len(hand_over_rows) - HAND_OVERS_SHOWN,
        known=_known,
    )


def _worst(difference: Difference) -> list[tuple[int, str]]:
    """Return the joints that differ most, and why they are shown."""
    chosen: dict[int, list[str]] = {}
    for gap in (difference.angle, difference.torque):
        if gap.worst is not None and gap.worst.difference:
            words = f"worst {gap.what}, {_known(gap.worst.difference)} {gap.unit} at {gap.worst.time_s:.2f} s"
            chosen.setdefault(gap.worst.joint, []).append(words)
    return [(joint, "; ".join(why)) for joint, why in chosen.items()]


def _known(value: float | None, unit: str = "") -> str:
    return UNKNOWN if value is None or not np.isfinite(value) else f"{shown(value, 3)} {unit}".strip()

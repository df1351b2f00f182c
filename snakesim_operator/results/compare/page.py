"""Renders the comparison of two runs as one self-contained HTML page that looks like the report of a run."""

from itertools import zip_longest
from pathlib import Path

import numpy as np

from snakesim_operator.results.compare import figures
from snakesim_operator.results.compare.difference import DIVERGENCE_THRESHOLD_RAD, RunDifference
from snakesim_operator.results.compare.verdict import (
    ToleranceCheck,
    describe_difference,
    describe_propulsion_order,
)
from snakesim_operator.results.page.html import format_number, render_page

UNKNOWN = "–"
HAND_OVERS_SHOWN = 40


def render_comparison_page(
    difference: RunDifference, tolerance_check: ToleranceCheck | None = None
) -> str:
    """Render the page that compares two runs as HTML.

    Args:
        difference: The comparison of the runs A and B.
        tolerance_check: Result of the option `--within`; None if the option is not set.
    """
    verdict = describe_difference(difference)
    verdict_class = ""  # CSS class that colors the verdict; empty without a tolerance
    if tolerance_check is not None:
        check_sentence = f"{tolerance_check.words[:1].upper()}{tolerance_check.words[1:]}."
        verdict = [*verdict, check_sentence]
        verdict_class = "good" if tolerance_check.holds else "bad"
    records = (difference.a, difference.b)
    hand_over_rows = list(zip_longest(difference.hand_overs.a, difference.hand_overs.b))
    return render_page(
        Path(__file__).parent / "compare.html",
        len(difference.joints),
        title=" and ".join(record.path.name for record in records),
        difference=difference,
        apart_rad=DIVERGENCE_THRESHOLD_RAD,
        records=records,
        kind=verdict_class,
        verdict=" ".join(verdict),
        maps=[("Angles", difference.angle), ("Torques", difference.torque)],
        figures=figures,
        worst=_list_most_different_joints(difference),
        who_propelled=describe_propulsion_order(difference),
        turns=hand_over_rows[:HAND_OVERS_SHOWN],
        more_turns=len(hand_over_rows) - HAND_OVERS_SHOWN,
        known=_format_known_value,
    )


def _list_most_different_joints(difference: RunDifference) -> list[tuple[int, str]]:
    """List the joints with the largest difference of angle or torque: joint index, and a text with the reason."""
    reasons_by_joint: dict[int, list[str]] = {}
    for gap in (difference.angle, difference.torque):
        if gap.max_difference is not None and gap.max_difference.difference:
            value = f"{_format_known_value(gap.max_difference.difference)} {gap.unit}"
            words = f"worst {gap.quantity}, {value} at {gap.max_difference.time_s:.2f} s"
            reasons_by_joint.setdefault(gap.max_difference.joint, []).append(words)
    return [(joint_index, "; ".join(reasons)) for joint_index, reasons in reasons_by_joint.items()]


def _format_known_value(value: float | None, unit: str = "") -> str:
    """Format a number with three digits and its unit, or a dash if it is unknown."""
    return (
        UNKNOWN
        if value is None or not np.isfinite(value)
        else f"{format_number(value, 3)} {unit}".strip()
    )

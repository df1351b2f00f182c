"""The charts of a comparison: A thick, B thin above it."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.compare.difference import Advance, Difference, Gap
from snakesim_operator.results.metrics.propulsion import find_propulsion_intervals
from snakesim_operator.results.page.charts import Bar, Figure, Line, Mark, bars, joint_map, lines

A, B = "--measured", "--reference"


def advance(difference: Difference, moved: Advance) -> list[Figure]:
    """Draw how far both runs moved, and by how much B was ahead."""
    time_s = difference.aligned.time_s
    end_s = max(float(moved.a.time_s[-1]), float(moved.b.time_s[-1]))
    advance_a_m = np.interp(time_s, moved.a.time_s, moved.a.value)
    advance_b_m = np.interp(time_s, moved.b.time_s, moved.b.value)
    ahead_mm = 1000 * (advance_b_m - advance_a_m)
    drawn = [Line("A", moved.a.time_s, moved.a.value, A, width=3.5), Line("B", moved.b.time_s, moved.b.value, B)]
    gap = Line("B − A", time_s, ahead_mm)
    marks = mark_divergence(difference)
    return [
        lines("Advance of both runs over time", "advance, m", drawn, end_s, marks=marks),
        lines("Difference of the advance over time", "B − A, mm", [gap], end_s, marks=marks, height=170),
    ]


def gap_map(difference: Difference, gap: Gap) -> Figure:
    """Draw the difference of every joint over time."""
    full = 1.0  # drawn in full color
    if gap.worst is not None:
        full = max(abs(gap.worst.difference), 1e-9)
    label = f"Difference of every joint's {gap.what} over time"
    until_s = float(difference.aligned.time_s[-1])
    return joint_map(
        label, difference.joints, gap.difference, gap.unit, full, until_s, marks=mark_divergence(difference)
    )


def overlay(difference: Difference, gap: Gap, a: Floats, b: Floats, joint: int) -> Figure:
    """Draw one joint in both runs, with a mark where they differ most."""
    time_s = difference.aligned.time_s
    worst = gap.joint_worst[joint]
    drawn = [Line("A", time_s, a[:, joint], A, width=3.5), Line("B", time_s, b[:, joint], B)]
    marks: list[Mark] = []
    if worst is not None and worst.difference:
        marks.append(Mark(worst.time_s, "worst"))
    label = f"{gap.what.capitalize()} of {difference.joints[joint]} in both runs"
    return lines(label, f"{gap.what}, {gap.unit}", drawn, float(time_s[-1]), marks=marks)


def hand_overs(difference: Difference) -> Figure:
    """Draw which joint propelled when: for each joint a row of A and one of B."""
    drawn: list[Bar] = []
    propelled: set[int] = set()
    for run, record, color in (("A", difference.a, A), ("B", difference.b, B)):
        for interval in find_propulsion_intervals(record):
            row = f"{difference.joints[interval.joint]} {run}"
            drawn.append(Bar(row, interval.start_s, interval.end_s, f"{run} {interval.duration_s:.1f} s", color))
            propelled.add(interval.joint)
    rows: list[str] = []
    for joint in sorted(propelled, reverse=True):
        rows += [f"{difference.joints[joint]} A", f"{difference.joints[joint]} B"]
    end_s = max([float(difference.aligned.time_s[-1]), *(bar.end_s for bar in drawn)])
    return bars("Propulsion joints of both runs over time", rows, drawn, end_s, mark_divergence(difference))


def mark_divergence(difference: Difference) -> list[Mark]:
    """Return a mark where the runs diverge."""
    if difference.divergence is None:
        return []
    return [Mark(difference.divergence.time_s, "diverge")]

"""Draws the charts of a comparison of two runs: a thick line for A, and a thin line for B above it."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.compare.difference import (
    AdvanceComparison,
    QuantityDifference,
    RunDifference,
)
from snakesim_operator.results.metrics.propulsion import find_propulsion_intervals
from snakesim_operator.results.page.charts import (
    ChartBar,
    ChartLine,
    PlotlyDict,
    TimeMarker,
    make_bar_chart,
    make_joint_heatmap,
    make_line_chart,
)

COLOR_A, COLOR_B = "--measured", "--reference"


def draw_advance(difference: RunDifference, moved: AdvanceComparison) -> list[PlotlyDict]:
    """Draw the advance of both runs over time, and the advance of B relative to A."""
    time_s = difference.aligned.time_s
    end_s = max(float(moved.a.time_s[-1]), float(moved.b.time_s[-1]))
    advance_a_m = np.interp(time_s, moved.a.time_s, moved.a.values)
    advance_b_m = np.interp(time_s, moved.b.time_s, moved.b.values)
    ahead_mm = 1000 * (advance_b_m - advance_a_m)
    drawn = [
        ChartLine("A", moved.a.time_s, moved.a.values, COLOR_A, width=3.5),
        ChartLine("B", moved.b.time_s, moved.b.values, COLOR_B),
    ]
    gap = ChartLine("B − A", time_s, ahead_mm)
    marks = mark_divergence(difference)
    return [
        make_line_chart(
            "Advance of both runs over time", "advance, m", drawn, end_s, markers=marks
        ),
        make_line_chart(
            "Difference of the advance over time",
            "B − A, mm",
            [gap],
            end_s,
            markers=marks,
            height=170,
        ),
    ]


def draw_difference_map(difference: RunDifference, gap: QuantityDifference) -> PlotlyDict:
    """Draw the difference of one quantity of all joints over time as a heatmap."""
    full = 1.0  # drawn in full color
    if gap.max_difference is not None:
        full = max(abs(gap.max_difference.difference), 1e-9)
    label = f"Difference of every joint's {gap.quantity} over time"
    until_s = float(difference.aligned.time_s[-1])
    return make_joint_heatmap(
        label,
        difference.joints,
        gap.difference,
        gap.unit,
        full,
        until_s,
        markers=mark_divergence(difference),
    )


def draw_joint_in_both_runs(
    difference: RunDifference, gap: QuantityDifference, a: Floats, b: Floats, joint_index: int
) -> PlotlyDict:
    """Draw one quantity of one joint in both runs over time, with a marker at the largest difference.

    Args:
        difference: The comparison.
        gap: Differences of the quantity.
        a: (n, joints) values of the quantity in A.
        b: (n, joints) values of the quantity in B.
        joint_index: Index of the joint.
    """
    time_s = difference.aligned.time_s
    worst = gap.max_difference_by_joint[joint_index]
    drawn = [
        ChartLine("A", time_s, a[:, joint_index], COLOR_A, width=3.5),
        ChartLine("B", time_s, b[:, joint_index], COLOR_B),
    ]
    marks: list[TimeMarker] = []
    if worst is not None and worst.difference:
        marks.append(TimeMarker(worst.time_s, "worst"))
    label = f"{gap.quantity.capitalize()} of {difference.joints[joint_index]} in both runs"
    return make_line_chart(
        label, f"{gap.quantity}, {gap.unit}", drawn, float(time_s[-1]), markers=marks
    )


def draw_hand_overs(difference: RunDifference) -> PlotlyDict:
    """Draw when each joint propelled, with one row for A and one for B."""
    drawn: list[ChartBar] = []
    propelled: set[int] = set()
    for run, record, color in (("A", difference.a, COLOR_A), ("B", difference.b, COLOR_B)):
        for interval in find_propulsion_intervals(record):
            row = f"{difference.joints[interval.joint_index]} {run}"
            drawn.append(
                ChartBar(
                    row,
                    interval.start_s,
                    interval.end_s,
                    f"{run} {interval.duration_s:.1f} s",
                    color,
                )
            )
            propelled.add(interval.joint_index)
    rows: list[str] = []
    for joint in sorted(propelled, reverse=True):
        rows += [f"{difference.joints[joint]} A", f"{difference.joints[joint]} B"]
    end_s = max([float(difference.aligned.time_s[-1]), *(bar.end_s for bar in drawn)])
    return make_bar_chart(
        "Propulsion joints of both runs over time", rows, drawn, end_s, mark_divergence(difference)
    )


def mark_divergence(difference: RunDifference) -> list[TimeMarker]:
    """Return a marker at the time at which the runs diverge; none if they do not diverge."""
    if difference.divergence is None:
        return []
    return [TimeMarker(difference.divergence.time_s, "diverge")]

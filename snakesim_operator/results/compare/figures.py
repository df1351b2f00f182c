"""The charts of a comparison: A thick, B thin above it."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.results.compare.difference import Advance, Difference, Gap
from snakesim_operator.results.metrics.propulsion import propulsion_intervals
from snakesim_operator.results.page.charts import Bar, Figure, Line, Mark, bars, joint_map, lines

A, B = "--measured", "--reference"


def advance(difference: Difference, moved: Advance) -> list[Figure]:
    """How far both came, and by how much B was ahead."""
    time_s, end_s = difference.aligned.time_s, max(float(moved.a.time_s[-1]), float(moved.b.time_s[-1]))
    ahead_mm = 1000 * (
        np.interp(time_s, moved.b.time_s, moved.b.value) - np.interp(time_s, moved.a.time_s, moved.a.value)
    )
    drawn = [Line("A", moved.a.time_s, moved.a.value, A, width=3.5), Line("B", moved.b.time_s, moved.b.value, B)]
    gap = Line("B − A", time_s, ahead_mm)
    marks = parted(difference)
    return [
        lines("Advance of both runs over time", "advance, m", drawn, end_s, marks=marks),
        lines("Difference of the advance over time", "B − A, mm", [gap], end_s, marks=marks, height=170),
    ]


def gap_map(difference: Difference, gap: Gap) -> Figure:
    """The difference of every joint over time."""
    full = max(abs(gap.worst.difference), 1e-9) if gap.worst is not None else 1.0
    label = f"Difference of every joint's {gap.what} over time"
    until_s = float(difference.aligned.time_s[-1])
    return joint_map(label, difference.joints, gap.difference, gap.unit, full, until_s, marks=parted(difference))


def overlay(difference: Difference, gap: Gap, a: Floats, b: Floats, joint: int) -> Figure:
    """One joint in both runs; marked where it is worst."""
    time_s, worst = difference.aligned.time_s, gap.joint_worst[joint]
    drawn = [Line("A", time_s, a[:, joint], A, width=3.5), Line("B", time_s, b[:, joint], B)]
    marks = [Mark(worst.time_s, "worst")] if worst is not None and worst.difference else []
    label = f"{gap.what.capitalize()} of {difference.joints[joint]} in both runs"
    return lines(label, f"{gap.what}, {gap.unit}", drawn, float(time_s[-1]), marks=marks)


def hand_overs(difference: Difference) -> Figure:
    """Which joint propelled when: for each joint a row of A and one of B."""
    runs = {"A": (difference.a, A), "B": (difference.b, B)}
    intervals = {run: propulsion_intervals(record) for run, (record, _) in runs.items()}
    joints = sorted({one.joint for run in intervals.values() for one in run}, reverse=True)
    drawn = [
        Bar(f"{difference.joints[one.joint]} {run}", one.start_s, one.end_s, f"{run} {one.length_s:.1f} s", color)
        for run, (_, color) in runs.items()
        for one in intervals[run]
    ]
    rows = [f"{difference.joints[joint]} {run}" for joint in joints for run in runs]
    end_s = max([float(difference.aligned.time_s[-1]), *(bar.end_s for bar in drawn)])
    return bars("Propulsion joints of both runs over time", rows, drawn, end_s, parted(difference))


def parted(difference: Difference) -> list[Mark]:
    """Where the runs diverge."""
    return [Mark(difference.parted.time_s, "diverge")] if difference.parted is not None else []

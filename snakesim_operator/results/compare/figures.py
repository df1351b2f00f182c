"""The charts of a comparison, made of the parts that the report has."""

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.compare.difference import Advance, Difference, Gap
from snakesim_operator.results.report import charts
from snakesim_operator.results.report.charts import Frame
from snakesim_operator.results.report.svg import element, line, text, title
from snakesim_operator.results.report.timeline import propulsion_intervals
from snakesim_operator.results.report.torque_map import joint_map

Floats = NDArray[np.float64]
LEFT = 66.0
ROW = 22.0  # of a joint in the picture of hand-overs


def advance(difference: Difference, moved: Advance, width: float) -> str:
    """How far both came."""
    low, high = charts.range_of([moved.a.value, moved.b.value], least=0.02, always=(0.0,))
    end_s = max(float(moved.a.time_s[-1]), float(moved.b.time_s[-1]))
    frame = Frame(width, 230, end_s, low, high, left=LEFT)
    return charts.chart(
        frame,
        "Advance of both runs over time",
        charts.axes(frame, "advance, m"),
        charts.curve(frame, moved.a.time_s, moved.a.value, "curve run-a"),
        charts.curve(frame, moved.b.time_s, moved.b.value, "curve run-b"),
        _parted(frame, difference),
    )


def advance_gap(difference: Difference, moved: Advance, width: float) -> str:
    """By how much B was ahead."""
    time_s = difference.aligned.time_s
    gap_mm = 1000 * (
        np.interp(time_s, moved.b.time_s, moved.b.value) - np.interp(time_s, moved.a.time_s, moved.a.value)
    )
    low, high = charts.range_of([gap_mm], least=1.0, always=(0.0,))
    frame = Frame(width, 150, float(time_s[-1]), low, high, left=LEFT)
    return charts.chart(
        frame,
        "Difference of the advance over time",
        charts.axes(frame, "B − A, mm"),
        charts.curve(frame, time_s, gap_mm, "curve ink"),
        _parted(frame, difference),
    )


def gap_map(difference: Difference, gap: Gap, width: float) -> str:
    """The difference of every joint over time."""
    marks = [difference.parted.time_s] if difference.parted is not None else []
    label = f"Difference of every joint's {gap.what} over time"
    until_s = float(difference.aligned.time_s[-1])
    return joint_map(label, difference.joints, gap.difference / full_colour(gap), until_s, [], width, *marks)


def full_colour(gap: Gap) -> float:
    """The difference that is drawn in full colour."""
    return max(abs(gap.worst.difference), 1e-9) if gap.worst is not None else 1.0


def overlay(difference: Difference, gap: Gap, a: Floats, b: Floats, joint: int, width: float) -> str:
    """One joint in both runs; marked where it is worst."""
    time_s = difference.aligned.time_s
    low, high = charts.range_of([a[:, joint], b[:, joint]], least=0.05)
    frame = Frame(width, 220, float(time_s[-1]), low, high + 0.1 * (high - low))
    worst = gap.joint_worst[joint]
    return charts.chart(
        frame,
        f"{gap.what.capitalize()} of {difference.joints[joint]} in both runs",
        charts.axes(frame, f"{gap.what}, {gap.unit}"),
        charts.mark(frame, worst.time_s, "worst") if worst is not None and worst.difference else "",
        charts.curve(frame, time_s, a[:, joint], "curve run-a"),
        charts.curve(frame, time_s, b[:, joint], "curve run-b"),
    )


def hand_overs(difference: Difference, width: float) -> str:
    """Which joint propelled when: A above B in each joint's row."""
    runs = [propulsion_intervals(record) for record in (difference.a, difference.b)]
    joints = sorted({one.joint for run in runs for one in run}, reverse=True)
    end_s = max([float(difference.aligned.time_s[-1]), *(one.end_s for run in runs for one in run)])
    frame = Frame(width, 12 + ROW * len(joints) + 36, end_s, 0, 1, left=LEFT)
    parts: list[str] = []
    for i, joint in enumerate(joints):
        top = frame.top + ROW * i
        if i:
            parts.append(line((frame.left, top), (frame.width - frame.right, top), "grid"))
        parts.append(text(frame.left - 7, top + ROW / 2 + 4, difference.joints[joint], "small", anchor="end"))
        for name, run, below in (("a", runs[0], 3.0), ("b", runs[1], ROW / 2 + 0.5)):
            for one in run:
                if one.joint != joint:
                    continue
                left, right = frame.x(one.start_s), frame.x(one.end_s)
                told = title(f"{name.upper()}, {one.start_s:.2f} to {one.end_s:.2f} s")
                bar = {"x": left, "y": top + below, "width": max(right - left, 1.0), "height": ROW / 2 - 3.5}
                parts.append(element("rect", told, class_=f"turn run-{name}", **bar))
    return charts.chart(
        frame, "Propulsion joints of both runs over time", *parts, _parted(frame, difference), charts.time_axis(frame)
    )


def _parted(frame: Frame, difference: Difference) -> str:
    return charts.mark(frame, difference.parted.time_s, "parted") if difference.parted is not None else ""

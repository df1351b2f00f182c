"""Charts over time: a frame with axes in round numbers, lines, shaded intervals, two-sided arrows, fault marks."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.report.palette import joint_class
from snakesim_operator.results.report.svg import (
    arrow,
    element,
    figure,
    line,
    polyline,
    round_step,
    text,
    text_width,
    tick_text,
    ticks,
    title,
)
from snakesim_operator.results.report.timeline import Band, Propulsion, thinned

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """Where time and value lie in a drawing."""

    width: float
    height: float
    end_s: float
    low: float
    high: float
    left: float = 54.0
    right: float = 14.0
    top: float = 12.0
    bottom: float = 36.0
    begin_s: float = 0.0

    def x(self, time_s: float) -> float:
        """Where a time is drawn; what lies outside is drawn at the edge."""
        share = (min(max(time_s, self.begin_s), self.end_s) - self.begin_s) / max(self.end_s - self.begin_s, 1e-9)
        return self.left + (self.width - self.left - self.right) * share

    def holds(self, time_s: Floats) -> NDArray[np.bool_]:
        """Which times are drawn, (n,)."""
        return (time_s >= self.begin_s) & (time_s <= self.end_s)

    def y(self, value: float) -> float:
        """Where a value is drawn."""
        share = (value - self.low) / max(self.high - self.low, 1e-12)
        return self.height - self.bottom - (self.height - self.top - self.bottom) * share


def range_of(values: Iterable[Floats], *, least: float, always: tuple[float, ...] = ()) -> tuple[float, float]:
    """A range that holds all finite values and `always`, at least `least` wide, with some air."""
    known = [v[np.isfinite(v)] for v in values]
    everything = np.concatenate([*known, np.array(always)]) if known or always else np.zeros(1)
    if not len(everything):
        everything = np.zeros(1)
    low, high = float(everything.min()), float(everything.max())
    if high - low < least:
        middle = (low + high) / 2
        low, high = middle - least / 2, middle + least / 2
    air = 0.06 * (high - low)
    return low - air, high + air


def axes(frame: Frame, unit_words: str) -> str:
    """Both axes with ticks, grid and names."""
    return value_axis(frame, unit_words) + time_axis(frame)


def value_axis(frame: Frame, unit_words: str) -> str:
    """The grid with its numbers at the left, and the name."""
    parts: list[str] = []
    inner = frame.height - frame.top - frame.bottom
    step = round_step(frame.high - frame.low, max(int(inner / 34), 2))
    for value in ticks(frame.low, frame.high, max(int(inner / 34), 2)):
        y = frame.y(value)
        parts.append(line((frame.left, y), (frame.width - frame.right, y), "zero" if value == 0 else "grid"))
        parts.append(text(frame.left - 7, y + 4, tick_text(value, step), "small", anchor="end"))
    middle = frame.top + inner / 2
    parts.append(text(14, middle, unit_words, "small soft", anchor="middle", turn=-90))
    return "".join(parts)


def time_axis(frame: Frame) -> str:
    """The line at the bottom with its ticks."""
    bottom = frame.height - frame.bottom
    most = max(int((frame.width - frame.left - frame.right) / 62), 2)
    step = round_step(frame.end_s - frame.begin_s, most)
    parts = [line((frame.left, bottom), (frame.width - frame.right, bottom), "axis")]
    for value in ticks(frame.begin_s, frame.end_s, most):
        x = frame.x(value)
        parts.append(line((x, bottom), (x, bottom + 4), "axis"))
        parts.append(text(x, bottom + 16, tick_text(value, step), "small", anchor="middle"))
    middle = (frame.left + frame.width - frame.right) / 2
    parts.append(text(middle, frame.height - 5, "time, s", "small soft", anchor="middle"))
    return "".join(parts)


def curve(frame: Frame, time_s: Floats, values: Floats, class_: str, *, steps: bool = False) -> str:
    """A line through a series, thinned, broken where it is unknown. steps: a value holds until the next."""
    parts: list[str] = []
    within = frame.holds(time_s)
    for piece in thinned(time_s[within], values[within]):
        points = [(frame.x(t), frame.y(v)) for t, v in piece]
        if steps:
            points = [p for a, b in pairwise(points) for p in (a, (b[0], a[1]))] + points[-1:]
        parts.append(polyline(points, class_))
    return "".join(parts)


def level(frame: Frame, value: float, class_: str, words: str = "") -> str:
    """A horizontal line, with its name above it at the right."""
    y = frame.y(value)
    named = text(frame.width - frame.right - 4, y - 4, words, "small soft halo", anchor="end") if words else ""
    return line((frame.left, y), (frame.width - frame.right, y), class_) + named


def shades(frame: Frame, intervals: list[Propulsion]) -> str:
    """Intervals in which a joint propelled: shaded in its colour, with a two-sided arrow at the top."""
    parts: list[str] = []
    for one in intervals:
        left, right = frame.x(one.start_s), frame.x(one.end_s)
        colour = joint_class(one.joint)
        parts.append(
            element(
                "rect",
                x=left,
                y=frame.top,
                width=max(right - left, 0.8),
                height=frame.height - frame.top - frame.bottom,
                class_=f"shade {colour}",
            )
        )
        y = frame.top + 7
        if right - left > 18:
            parts.append(arrow((left + 0.5, y), (right - 0.5, y), f"span {colour}", head=8, both=True))
        else:
            parts.append(line((left, y), (right, y), f"span {colour} shaft"))
    return "".join(parts)


def strip(frame: Frame, bands: list[Band], top: float, height: float, *, named: bool = True) -> str:
    """A row of coloured bands; a name stands in each that has room for it."""
    parts: list[str] = []
    for band in bands:
        left, right = frame.x(band.start_s), frame.x(band.end_s)
        box = element(
            "rect",
            title(f"{band.what}, {band.start_s:.2f} to {band.end_s:.2f} s"),
            x=left,
            y=top,
            width=max(right - left, 0.8),
            height=height,
            class_=f"band band-{band.what.lower()}",
        )
        parts.append(box)
        if named and right - left > text_width(band.what, 12) + 8:
            parts.append(text((left + right) / 2, top + height / 2 + 4, band.what, "small", anchor="middle"))
    return "".join(parts)


def mark(frame: Frame, time_s: float, words: str = "") -> str:
    """A dashed line at an instant, with its name beside it at the top."""
    x = frame.x(time_s)
    left = x + 4 + text_width(words, 12) > frame.width - frame.right
    named = text(x - 4 if left else x + 4, frame.top + 10, words, "small soft halo", anchor="end" if left else "start")
    return line((x, frame.top), (x, frame.height - frame.bottom), "mark") + (named if words else "")


def fault_marks(frame: Frame, times_s: list[float]) -> str:
    """A dashed line at every fault, named once."""
    parts = [
        line((frame.x(t), frame.top), (frame.x(t), frame.height - frame.bottom), "fault-mark")
        for t in times_s
        if frame.begin_s <= t <= frame.end_s
    ]
    return "".join(parts)


def chart(frame: Frame, label: str, *parts: str) -> str:
    """The drawing, with what the time cursor needs to know of it."""
    return figure(
        frame.width,
        frame.height,
        label,
        *parts,
        data_left=frame.left,
        data_right=frame.width - frame.right,
        data_top=frame.top,
        data_bottom=frame.height - frame.bottom,
        data_begin_s=f"{frame.begin_s:.6g}",
        data_end_s=f"{frame.end_s:.6g}",
    )

"""Charts over time as figures of Plotly: lines, bars, and a map of all joints. Pure data, as JSON will have it.

A color is the name of one in the palette (`--measured`): `charts.js` looks it up, so that a chart follows the theme.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

Figure = dict[str, Any]
LIBRARY = Path(__file__).parent / "vendor" / "plotly-cartesian.min.js"
BUCKETS = 500  # of time; each keeps its smallest and its largest value
MAP_COLUMNS = 480
ROW = 25  # height of a row of bars: enough for words of 11 px in them
MAX_BARS = 2000
NAMED_SHARE = 0.03  # of the time: a shorter bar has no room for words


@dataclass(frozen=True)
class Line:
    """A series, and how it is drawn. NaN breaks the line."""

    name: str
    time_s: Floats
    values: Floats
    color: str = "--ink"
    dash: str = "solid"
    width: float = 1.6
    shape: str = "linear"  # hv: a value holds until the next one

    def trace(self) -> Figure:
        """Return the line as a trace of Plotly."""
        rows = thinned(self.values)
        return {
            "type": "scatter",
            "mode": "lines",
            "name": self.name,
            "x": np.round(self.time_s[rows], 4).tolist(),
            "y": rounded(self.values[rows]),
            "line": {"color": self.color, "dash": self.dash, "width": self.width, "shape": self.shape},
        }


@dataclass(frozen=True)
class Bar:
    """Something that held for a while, in a row of its own or with others."""

    row: str
    start_s: float
    end_s: float
    words: str
    color: str


@dataclass(frozen=True)
class Mark:
    """A dashed line at one time. Few have a name."""

    time_s: float
    words: str = ""
    color: str = "--soft"


def lines(
    label: str,
    axis: str,
    drawn: Sequence[Line],
    until_s: float,
    *,
    levels: Sequence[tuple[float, str]] = (),
    shades: Sequence[Bar] = (),
    marks: Sequence[Mark] = (),
    height: int = 220,
    from_zero: bool = False,
) -> Figure:
    """Draw lines over time.

    Args:
        label: Title of the chart.
        axis: Title of the vertical axis.
        drawn: The lines.
        until_s: End of the time axis.
        levels: Values with a name, as dotted lines.
        shades: Spans of time with a color.
        marks: Instants.
        height: Height in pixels.
        from_zero: The vertical axis begins at 0.
    """
    shapes = [_box(bar.start_s, bar.end_s, 0, 1, "paper", fillcolor=bar.color, opacity=0.16) for bar in shades]
    shapes += [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y, "line": _stroke("--soft", "dot")}
        for y, _ in levels
    ]
    notes = [
        {"xref": "paper", "x": 1, "xanchor": "right", "y": y, "yanchor": "bottom", "text": words, "showarrow": False}
        for y, words in levels
        if words
    ]
    axis_y: Figure = {"title": {"text": axis}, "rangemode": "tozero" if from_zero else "normal"}
    layout = {"showlegend": len(drawn) > 1, "hovermode": "x unified", "yaxis": axis_y}
    return _figure(label, [line.trace() for line in drawn], height, until_s, shapes, notes, marks, layout)


def bars(label: str, rows: Sequence[str], drawn: Sequence[Bar], until_s: float, marks: Sequence[Mark] = ()) -> Figure:
    """Draw what held when, in rows, the first on top. Of more than MAX_BARS the longest are drawn."""
    drawn = sorted(drawn, key=lambda bar: bar.start_s - bar.end_s)[:MAX_BARS]
    trace = {
        "type": "bar",
        "orientation": "h",
        "base": [round(bar.start_s, 4) for bar in drawn],
        "x": [round(bar.end_s - bar.start_s, 4) for bar in drawn],
        "y": [bar.row for bar in drawn],
        "text": [bar.words if bar.end_s - bar.start_s > NAMED_SHARE * until_s else "" for bar in drawn],
        "textposition": "inside",
        "insidetextanchor": "middle",
        "constraintext": "both",
        "hovertext": [f"{bar.words}, {bar.start_s:.2f} to {bar.end_s:.2f} s" for bar in drawn],
        "hoverinfo": "text",
        "marker": {"color": [bar.color for bar in drawn], "line": {"width": 0}},
    }
    layout = {
        "barmode": "overlay",
        "bargap": 0.12,
        "hovermode": "closest",
        "yaxis": {"type": "category", "categoryarray": list(rows)[::-1], "range": [-0.5, len(rows) - 0.5]},
    }
    return _figure(label, [trace], 64 + ROW * len(rows), until_s, [], [], marks, layout)


def joint_map(
    label: str,
    joints: Sequence[str],
    values: Floats,
    unit: str,
    full: float,
    until_s: float,
    *,
    frames: Sequence[tuple[float, float, int]] = (),
    marks: Sequence[Mark] = (),
) -> Figure:
    """Values (n, joints) over time, a row a joint, head on top; `full` is drawn in full color.

    frames: begin (s), end (s) and joint index of each frame that marks a joint.
    """
    columns = strongest(values, MAP_COLUMNS)
    step_s = until_s / len(columns)
    trace = {
        "type": "heatmap",
        "x0": step_s / 2,
        "dx": step_s,
        "y": list(joints),
        "z": [rounded(row) for row in columns.T],
        "zmin": -full,
        "zmax": full,
        "colorscale": [[0, "--negative"], [0.5, "--card"], [1, "--positive"]],
        "showscale": False,
        "hovertemplate": f"%{{y}}, %{{x:.2f}} s: %{{z:.3g}} {unit}",
        "name": "",
    }
    shapes = [_box(a, b, j - 0.5, j + 0.5, "y", line={"color": "--ink", "width": 1.2}) for a, b, j in frames]
    height = 60 + min(max(len(joints) * 18, 120), 420)
    layout = {"hovermode": "closest", "yaxis": {"type": "category", "nticks": 16, "showgrid": False}}
    return _figure(label, [trace], height, until_s, shapes, [], marks, layout)


def thinned(values: Floats, buckets: int = BUCKETS) -> NDArray[np.intp]:
    """Return the rows to draw: for each bucket of time the minimum, the maximum, and one that is unknown."""
    if len(values) <= 2 * buckets:
        return np.arange(len(values))
    keep = {0, len(values) - 1}
    for part in np.array_split(np.arange(len(values)), buckets):
        known = part[np.isfinite(values[part])]
        if len(known):
            keep |= {int(known[values[known].argmin()]), int(known[values[known].argmax()])}
        keep |= set(np.setdiff1d(part, known)[:1].tolist())
    return np.array(sorted(keep))


def strongest(values: Floats, columns: int) -> Floats:
    """Return at most `columns` rows, each with the value of largest size in its bucket of time; NaN: none is known."""
    if len(values) <= columns:
        return values
    largest: list[Floats] = []
    edges = np.round(np.linspace(0, len(values), columns + 1)).astype(int)
    for part in (values[first:last] for first, last in pairwise(edges.tolist())):
        sizes = np.where(np.isfinite(part), np.abs(part), -1.0)
        largest.append(part[sizes.argmax(axis=0), np.arange(values.shape[1])])
    return np.array(largest)


def rounded(values: Floats) -> list[float | None]:
    """Return the values with four digits; None for unknown ones."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]


def _figure(
    label: str,
    traces: list[Figure],
    height: int,
    until_s: float,
    shapes: list[Figure],
    notes: list[Figure],
    marks: Sequence[Mark],
    layout: Figure,
) -> Figure:
    """Return a figure with its marks and its time axis."""
    for mark in marks:
        place = {"x0": mark.time_s, "x1": mark.time_s, "yref": "paper", "y0": 0, "y1": 1}
        shapes.append({"type": "line", "line": _stroke(mark.color, "dash"), **place})
        if mark.words:
            note = {"x": mark.time_s, "yref": "paper", "y": 1, "yanchor": "top", "showarrow": False, "text": mark.words}
            has_room_right = mark.time_s < until_s / 2
            anchor = "left" if has_room_right else "right"
            shift = 4 if has_room_right else -4
            notes.append({**note, "xanchor": anchor, "xshift": shift})
    time_axis = {"range": [0, round(until_s, 4)], "title": {"text": "time, s"}}
    layout = {**layout, "height": height, "xaxis": time_axis, "shapes": shapes, "annotations": notes}
    return {"label": label, "data": traces, "layout": layout}


def _box(x0: float, x1: float, y0: float, y1: float, yref: str, **look: Any) -> Figure:
    layer = "below" if yref == "paper" else "above"
    at = {"x0": x0, "x1": x1, "y0": y0, "y1": y1, "yref": yref}
    return {"type": "rect", "layer": layer, "line": {"width": 0}, **at, **look}


def _stroke(color: str, dash: str) -> Figure:
    return {"color": color, "dash": dash, "width": 1.2}

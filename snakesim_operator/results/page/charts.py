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
    """Return a Plotly figure of lines over time.

    Args:
        label: Title of the chart.
        axis: Title of the vertical axis.
        drawn: The lines.
        until_s: End of the time axis, in s.
        levels: Values on the vertical axis that get a dotted line, each with its name; the name may be empty.
        shades: Spans of time whose background is colored.
        marks: Instants that get a dashed vertical line.
        height: Height in pixels.
        from_zero: Whether the vertical axis begins at 0.
    """
    shapes = [_box(span.start_s, span.end_s, 0, 1, "paper", fillcolor=span.color, opacity=0.16) for span in shades]
    notes: list[Figure] = []
    for value, name in levels:
        level_line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": value, "y1": value}
        shapes.append({**level_line, "line": _stroke("--soft", "dot")})
        if name:
            position = {"xref": "paper", "x": 1, "xanchor": "right", "y": value, "yanchor": "bottom"}
            notes.append({**position, "text": name, "showarrow": False})
    range_mode = "tozero" if from_zero else "normal"
    layout = {
        "showlegend": len(drawn) > 1,
        "hovermode": "x unified",
        "yaxis": {"title": {"text": axis}, "rangemode": range_mode},
    }
    traces = [line.trace() for line in drawn]
    return _figure(label, traces, height, until_s, shapes, notes, marks, layout)


def bars(label: str, rows: Sequence[str], drawn: Sequence[Bar], until_s: float, marks: Sequence[Mark] = ()) -> Figure:
    """Return a Plotly figure of horizontal bars over time, such as the states of a run.

    Args:
        label: Title of the chart.
        rows: Names of the rows; the first is on top.
        drawn: The bars, each in one of the rows. The longest MAX_BARS are drawn if there are more.
        until_s: End of the time axis, in s.
        marks: Instants that get a dashed vertical line.
    """
    longest_first = sorted(drawn, key=lambda bar: bar.start_s - bar.end_s)
    shown = longest_first[:MAX_BARS]
    min_labeled_s = NAMED_SHARE * until_s
    durations_s = [bar.end_s - bar.start_s for bar in shown]
    texts: list[str] = []
    for bar, duration_s in zip(shown, durations_s, strict=True):
        texts.append(bar.words if duration_s > min_labeled_s else "")
    trace = {
        "type": "bar",
        "orientation": "h",
        "base": [round(bar.start_s, 4) for bar in shown],
        "x": [round(duration_s, 4) for duration_s in durations_s],
        "y": [bar.row for bar in shown],
        "text": texts,
        "textposition": "inside",
        "insidetextanchor": "middle",
        "constraintext": "both",
        "hovertext": [f"{bar.words}, {bar.start_s:.2f} to {bar.end_s:.2f} s" for bar in shown],
        "hoverinfo": "text",
        "marker": {"color": [bar.color for bar in shown], "line": {"width": 0}},
    }
    bottom_to_top = list(rows)[::-1]  # Plotly puts the first category at the bottom
    layout = {
        "barmode": "overlay",
        "bargap": 0.12,
        "hovermode": "closest",
        "yaxis": {"type": "category", "categoryarray": bottom_to_top, "range": [-0.5, len(rows) - 0.5]},
    }
    height = 64 + ROW * len(rows)
    return _figure(label, [trace], height, until_s, [], [], marks, layout)


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
    """Return a Plotly heatmap of one quantity of all joints over time, with a row for each joint and the head on top.

    Args:
        label: Title of the chart.
        joints: Names of the joints, tail to head.
        values: (n, joints) values at equal intervals of time.
        unit: Unit of the values.
        full: Absolute value that has the strongest color.
        until_s: End of the time axis, in s.
        frames: Rectangles that highlight a joint for some time: start in s, end in s and index of the joint.
        marks: Instants that get a dashed vertical line.
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
    shapes: list[Figure] = []
    for start_s, end_s, joint in frames:
        outline = {"color": "--ink", "width": 1.2}
        shapes.append(_box(start_s, end_s, joint - 0.5, joint + 0.5, "y", line=outline))
    rows_height = min(max(len(joints) * 18, 120), 420)
    layout = {"hovermode": "closest", "yaxis": {"type": "category", "nticks": 16, "showgrid": False}}
    return _figure(label, [trace], 60 + rows_height, until_s, shapes, [], marks, layout)


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
    """Assemble a Plotly figure with a time axis, and draw marks as dashed vertical lines.

    Args:
        label: Title of the chart.
        traces: Plotly traces.
        height: Height in pixels.
        until_s: End of the time axis, in s.
        shapes: Plotly shapes; those of the marks are added.
        notes: Plotly annotations; those of the marks are added.
        marks: Instants to mark.
        layout: Further keys of the Plotly layout.
    """
    for mark in marks:
        line = {"x0": mark.time_s, "x1": mark.time_s, "yref": "paper", "y0": 0, "y1": 1}
        shapes.append({"type": "line", "line": _stroke(mark.color, "dash"), **line})
        if mark.words:
            notes.append(_mark_note(mark, until_s))
    time_axis = {"range": [0, round(until_s, 4)], "title": {"text": "time, s"}}
    full_layout = {**layout, "height": height, "xaxis": time_axis, "shapes": shapes, "annotations": notes}
    return {"label": label, "data": traces, "layout": full_layout}


def _mark_note(mark: Mark, until_s: float) -> Figure:
    """Return the name of a mark as a Plotly annotation, on the side of the line that has more room."""
    is_in_left_half = mark.time_s < until_s / 2
    anchor = "left" if is_in_left_half else "right"
    shift = 4 if is_in_left_half else -4  # px
    position = {"x": mark.time_s, "yref": "paper", "y": 1, "yanchor": "top"}
    return {**position, "showarrow": False, "text": mark.words, "xanchor": anchor, "xshift": shift}


def _box(x0: float, x1: float, y0: float, y1: float, yref: str, **look: Any) -> Figure:
    layer = "below" if yref == "paper" else "above"
    at = {"x0": x0, "x1": x1, "y0": y0, "y1": y1, "yref": yref}
    return {"type": "rect", "layer": layer, "line": {"width": 0}, **at, **look}


def _stroke(color: str, dash: str) -> Figure:
    return {"color": color, "dash": dash, "width": 1.2}

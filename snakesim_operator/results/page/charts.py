"""Makes charts over time as plain data for Plotly: lines, bars, and a heatmap of all joints.

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

PlotlyDict = dict[str, Any]
LIBRARY = Path(__file__).parent / "vendor" / "plotly-cartesian.min.js"
TIME_BUCKET_COUNT = 500  # of the time axis; of each bucket the minimum and the maximum are drawn
MAP_COLUMNS = 480
ROW_HEIGHT_PX = 25  # height of a row of bars in px, enough for text of 11 px
BAR_CHART_MARGIN_PX = 64  # above and below the rows of bars, for the title and the time axis
MAX_BARS = 2000
MIN_LABELED_FRACTION = 0.03  # of the time axis; a shorter bar has no room for its text


@dataclass(frozen=True)
class ChartLine:
    """A time series and the style of its line. NaN interrupts the line."""

    name: str
    time_s: Floats
    values: Floats
    color: str = "--ink"
    dash: str = "solid"
    width: float = 1.6
    shape: str = "linear"  # hv: a value holds until the next one

    def make_trace(self) -> PlotlyDict:
        """Make the Plotly trace of the line, with at most a few thousand points."""
        rows = select_rows_to_draw(self.values)
        return {
            "type": "scatter",
            "mode": "lines",
            "name": self.name,
            "x": np.round(self.time_s[rows], 4).tolist(),
            "y": round_values(self.values[rows]),
            "line": {
                "color": self.color,
                "dash": self.dash,
                "width": self.width,
                "shape": self.shape,
            },
        }


@dataclass(frozen=True)
class ChartBar:
    """A horizontal bar for an interval of time, in a named row that may have several bars."""

    row: str
    start_s: float
    end_s: float
    text: str
    color: str


@dataclass(frozen=True)
class TimeMarker:
    """A dashed vertical line at one time, with an optional text."""

    time_s: float
    text: str = ""
    color: str = "--soft"


def make_line_chart(
    title: str,
    axis: str,
    drawn_lines: Sequence[ChartLine],
    end_s: float,
    *,
    levels: Sequence[tuple[float, str]] = (),
    shades: Sequence[ChartBar] = (),
    markers: Sequence[TimeMarker] = (),
    height: int = 220,
    from_zero: bool = False,
) -> PlotlyDict:
    """Make a Plotly chart of lines over time.

    Args:
        title: Title of the chart.
        axis: Title of the vertical axis.
        drawn_lines: The lines.
        end_s: End of the time axis, in s.
        levels: Values on the vertical axis that get a dotted line, each with its name; the name may be empty.
        shades: Spans of time whose background is colored.
        markers: Times that get a dashed vertical line.
        height: Height in pixels.
        from_zero: Whether the vertical axis begins at 0.
    """
    shapes = [
        _make_rectangle(span.start_s, span.end_s, 0, 1, "paper", fillcolor=span.color, opacity=0.16)
        for span in shades
    ]
    annotations: list[PlotlyDict] = []
    for value, name in levels:
        level_line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": value, "y1": value}
        shapes.append({**level_line, "line": _make_line_style("--soft", "dot")})
        if name:
            position = {
                "xref": "paper",
                "x": 1,
                "xanchor": "right",
                "y": value,
                "yanchor": "bottom",
            }
            annotations.append({**position, "text": name, "showarrow": False})
    range_mode = "tozero" if from_zero else "normal"
    layout = {
        "showlegend": len(drawn_lines) > 1,
        "hovermode": "x unified",
        "yaxis": {"title": {"text": axis}, "rangemode": range_mode},
    }
    traces = [line.make_trace() for line in drawn_lines]
    return _make_time_figure(
        title,
        traces,
        height,
        end_s,
        shapes=shapes,
        annotations=annotations,
        markers=markers,
        layout=layout,
    )


def make_bar_chart(
    title: str,
    rows: Sequence[str],
    bars: Sequence[ChartBar],
    end_s: float,
    markers: Sequence[TimeMarker] = (),
) -> PlotlyDict:
    """Make a Plotly chart of horizontal bars over time, such as the states of a run.

    Args:
        title: Title of the chart.
        rows: Names of the rows; the first is on top.
        bars: The bars, each in one of the rows. If there are more than MAX_BARS, only the longest are drawn.
        end_s: End of the time axis, in s.
        markers: Times that get a dashed vertical line.
    """
    longest_first = sorted(bars, key=lambda bar: bar.end_s - bar.start_s, reverse=True)
    shown = longest_first[:MAX_BARS]
    min_labeled_s = MIN_LABELED_FRACTION * end_s
    durations_s = [bar.end_s - bar.start_s for bar in shown]
    texts: list[str] = []
    for bar, duration_s in zip(shown, durations_s, strict=True):
        texts.append(bar.text if duration_s > min_labeled_s else "")
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
        "hovertext": [f"{bar.text}, {bar.start_s:.2f} to {bar.end_s:.2f} s" for bar in shown],
        "hoverinfo": "text",
        "marker": {"color": [bar.color for bar in shown], "line": {"width": 0}},
    }
    bottom_to_top = list(rows)[::-1]  # Plotly puts the first category at the bottom
    layout = {
        "barmode": "overlay",
        "bargap": 0.12,
        "hovermode": "closest",
        "yaxis": {
            "type": "category",
            "categoryarray": bottom_to_top,
            "range": [-0.5, len(rows) - 0.5],
        },
    }
    height = BAR_CHART_MARGIN_PX + ROW_HEIGHT_PX * len(rows)
    return _make_time_figure(
        title, [trace], height, end_s, shapes=[], annotations=[], markers=markers, layout=layout
    )


def make_joint_heatmap(
    title: str,
    joints: Sequence[str],
    values: Floats,
    unit: str,
    full_color_value: float,
    end_s: float,
    *,
    frames: Sequence[tuple[float, float, int]] = (),
    markers: Sequence[TimeMarker] = (),
) -> PlotlyDict:
    """Make a Plotly heatmap of one quantity of all joints over time, with a row for each joint and the head on top.

    Args:
        title: Title of the chart.
        joints: Names of the joints, tail to head.
        values: (n, joints) values at equal intervals of time.
        unit: Unit of the values.
        full_color_value: Absolute value that is drawn in the strongest color.
        end_s: End of the time axis, in s.
        frames: Rectangles that highlight a joint for some time: start in s, end in s and index of the joint.
        markers: Times that get a dashed vertical line.
    """
    columns = find_strongest_per_bucket(values, MAP_COLUMNS)
    step_s = end_s / len(columns)
    trace = {
        "type": "heatmap",
        "x0": step_s / 2,
        "dx": step_s,
        "y": list(joints),
        "z": [round_values(row) for row in columns.T],
        "zmin": -full_color_value,
        "zmax": full_color_value,
        "colorscale": [[0, "--negative"], [0.5, "--card"], [1, "--positive"]],
        "showscale": False,
        "hovertemplate": f"%{{y}}, %{{x:.2f}} s: %{{z:.3g}} {unit}",
        "name": "",
    }
    shapes: list[PlotlyDict] = []
    for start_s, end_s, joint in frames:
        outline = {"color": "--ink", "width": 1.2}
        shapes.append(_make_rectangle(start_s, end_s, joint - 0.5, joint + 0.5, "y", line=outline))
    rows_height = min(max(len(joints) * 18, 120), 420)
    layout = {
        "hovermode": "closest",
        "yaxis": {"type": "category", "nticks": 16, "showgrid": False},
    }
    return _make_time_figure(
        title,
        [trace],
        60 + rows_height,
        end_s,
        shapes=shapes,
        annotations=[],
        markers=markers,
        layout=layout,
    )


def select_rows_to_draw(values: Floats, buckets: int = TIME_BUCKET_COUNT) -> NDArray[np.intp]:
    """Select the rows to draw: in each bucket of time the minimum, the maximum, and the first unknown value."""
    if len(values) <= 2 * buckets:
        return np.arange(len(values))
    keep = {0, len(values) - 1}
    for part in np.array_split(np.arange(len(values)), buckets):
        known = part[np.isfinite(values[part])]
        if len(known):
            keep |= {int(known[values[known].argmin()]), int(known[values[known].argmax()])}
        keep |= set(np.setdiff1d(part, known)[:1].tolist())
    return np.array(sorted(keep))


def find_strongest_per_bucket(values: Floats, columns: int) -> Floats:
    """Reduce values to at most `columns` rows: the value of largest magnitude in each bucket of time.

    A value is NaN if no value in its bucket is known.
    """
    if len(values) <= columns:
        return values
    largest: list[Floats] = []
    edges = np.round(np.linspace(0, len(values), columns + 1)).astype(int)
    for bucket in (values[first:last] for first, last in pairwise(edges.tolist())):
        magnitudes = np.where(np.isfinite(bucket), np.abs(bucket), -1.0)
        largest.append(bucket[magnitudes.argmax(axis=0), np.arange(values.shape[1])])
    return np.array(largest)


def round_values(values: Floats) -> list[float | None]:
    """Round values to four significant digits; an unknown value becomes None."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]


def _make_time_figure(
    title: str,
    traces: list[PlotlyDict],
    height: int,
    end_s: float,
    *,
    shapes: list[PlotlyDict],
    annotations: list[PlotlyDict],
    markers: Sequence[TimeMarker],
    layout: PlotlyDict,
) -> PlotlyDict:
    """Assemble a Plotly figure with a time axis and dashed vertical lines for the markers.

    Args:
        title: Title of the chart.
        traces: Plotly traces.
        height: Height in pixels.
        end_s: End of the time axis, in s.
        shapes: Plotly shapes of the chart.
        annotations: Plotly annotations of the chart.
        markers: Times to mark by a line, each with its text.
        layout: Further keys of the Plotly layout.
    """
    all_shapes = list(shapes)
    all_annotations = list(annotations)
    for marker in markers:
        line = {"x0": marker.time_s, "x1": marker.time_s, "yref": "paper", "y0": 0, "y1": 1}
        all_shapes.append({"type": "line", "line": _make_line_style(marker.color, "dash"), **line})
        if marker.text:
            all_annotations.append(_make_marker_annotation(marker, end_s))
    time_axis = {"range": [0, round(end_s, 4)], "title": {"text": "time, s"}}
    full_layout = {
        **layout,
        "height": height,
        "xaxis": time_axis,
        "shapes": all_shapes,
        "annotations": all_annotations,
    }
    return {"label": title, "data": traces, "layout": full_layout}


def _make_marker_annotation(marker: TimeMarker, end_s: float) -> PlotlyDict:
    """Make the Plotly annotation for the text of a marker, on the side of its line that has more room."""
    is_in_left_half = marker.time_s < end_s / 2
    anchor = "left" if is_in_left_half else "right"
    shift = 4 if is_in_left_half else -4  # px
    position = {"x": marker.time_s, "yref": "paper", "y": 1, "yanchor": "top"}
    return {**position, "showarrow": False, "text": marker.text, "xanchor": anchor, "xshift": shift}


def _make_rectangle(
    x0: float, x1: float, y0: float, y1: float, yref: str, **style: Any
) -> PlotlyDict:
    layer = "below" if yref == "paper" else "above"
    corners = {"x0": x0, "x1": x1, "y0": y0, "y1": y1, "yref": yref}
    return {"type": "rect", "layer": layer, "line": {"width": 0}, **corners, **style}


def _make_line_style(color: str, dash: str) -> PlotlyDict:
    return {"color": color, "dash": dash, "width": 1.2}

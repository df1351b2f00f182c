"""Draws an evaluation as one page that needs no network and no other file; it looks like the report of a run."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.evaluate.table import (
    ResultRow,
    compute_wilson_interval,
    find_best_controller,
    make_result_table,
)
from snakesim_operator.results.page.charts import PlotlyDict
from snakesim_operator.results.page.html import render_page

FIGURE_HEIGHT_PX = 300
# Of the distance between two settings, over which the points of the controllers are spread.
CONTROLLER_SPREAD = 0.5
ValueWithInterval = tuple[float, float, float]  # middle, lower and upper end
ComputeValue = Callable[[ResultRow], ValueWithInterval | None]


def render_evaluation_page(
    title: str, source: str, rows: Sequence[ResultRow], failures: Sequence[tuple[str, str, str]]
) -> str:
    """Return the page about an evaluation as HTML: its figures, the table of results, and the worst failures.

    Args:
        title: Heading of the page.
        source: Path of the suite file, or the command that stands for one.
        rows: Rows of the table of results.
        failures: The worst cases, each as name, reason, and the command that runs it again.
    """
    controllers = list(dict.fromkeys(row.controller for row in rows))
    headings, *table_rows = make_result_table(rows)
    return render_page(
        Path(__file__).parent / "evaluation.html",
        len(controllers),
        title=title,
        about=source,
        runs=sum(row.runs for row in rows),
        figures=[
            _draw_figure("Success rate, %", rows, controllers, _compute_success_rate_percent),
            _draw_figure(
                "Speed, m/s",
                rows,
                controllers,
                _make_quartile_function("advance_m_s", successful_only=True),
            ),
            _draw_figure(
                "Energy, J/m",
                rows,
                controllers,
                _make_quartile_function("energy_j_per_m", successful_only=True),
            ),
            _draw_figure("Advance, m", rows, controllers, _make_quartile_function("advance_m")),
            _draw_figure(
                "Net speed, m/s", rows, controllers, _make_quartile_function("displacement_m_s")
            ),
            _draw_figure(
                "Net energy, J/m",
                rows,
                controllers,
                _make_quartile_function("displacement_energy_j_per_m"),
            ),
            _draw_figure(
                "Stalled time, s", rows, controllers, _make_quartile_function("stalled_s")
            ),
        ],
        goals=any(row.success_count is not None for row in rows),
        head=headings,
        rows=table_rows,
        worst=failures,
        best=find_best_controller(rows),
    )


def _compute_success_rate_percent(row: ResultRow) -> ValueWithInterval | None:
    """Return the success rate with its 95 % interval, in percent; None without a goal."""
    if row.success_count is None:
        return None
    low, high = compute_wilson_interval(row.success_count, row.runs)
    return 100 * row.success_count / row.runs, 100 * low, 100 * high


def _make_quartile_function(name: str, *, successful_only: bool = False) -> ComputeValue:
    """Return a function that computes median and quartiles of a metric in a row; it returns None if none is known."""

    def quartiles(row: ResultRow) -> ValueWithInterval | None:
        values = row.list_values(name, successful_only=successful_only)
        if not values:
            return None
        middle, lower, upper = np.percentile(values, [50, 25, 75]).tolist()
        return middle, lower, upper

    return quartiles


def _draw_figure(
    axis_title: str,
    rows: Sequence[ResultRow],
    controllers: Sequence[str],
    compute_value: ComputeValue,
) -> PlotlyDict | None:
    """Draw a number of the results, with one point for each row and one color for each controller.

    Args:
        axis_title: Title of the vertical axis.
        rows: Rows of the table of results.
        controllers: The controllers, in the order of their colors.
        compute_value: Returns the value of a row with its interval, or None if the row has no value.

    Returns:
        The figure as Plotly has it; None if no row has a value. If a number is varied, it is the horizontal axis.
        Otherwise the settings are.
    """
    has_number_axis = all(row.value is not None for row in rows)
    traces: list[PlotlyDict] = []
    for color_index, controller in enumerate(controllers):
        points: list[tuple[ResultRow, ValueWithInterval]] = []
        for row in rows:
            point = compute_value(row) if row.controller == controller else None
            if point is not None:
                points.append((row, point))
        if points:
            # Controllers are drawn side by side, so that they do not hide each other.
            offset = CONTROLLER_SPREAD * ((color_index + 0.5) / len(controllers) - 0.5)
            traces.append(
                _draw_trace(
                    controller,
                    color_index,
                    points,
                    has_number_axis=has_number_axis,
                    x_offset=offset,
                )
            )
    if not traces:
        return None
    x_axis: PlotlyDict = {"title": {"text": ""}}
    if not has_number_axis:
        x_axis |= _make_setting_axis(rows)
    layout = {
        "height": FIGURE_HEIGHT_PX,
        "hovermode": "closest",
        "showlegend": len(controllers) > 1,
        "xaxis": x_axis,
        "yaxis": {"title": {"text": axis_title}, "rangemode": "tozero"},
        "shapes": [],
        "annotations": [],
    }
    return {"label": axis_title, "data": traces, "layout": layout}


def _draw_trace(
    controller: str,
    color_index: int,
    points: Sequence[tuple[ResultRow, ValueWithInterval]],
    *,
    has_number_axis: bool,
    x_offset: float,
) -> PlotlyDict:
    """Make a Plotly trace with the points of one controller and their error bars.

    Args:
        controller: Name of the controller.
        color_index: Index of the controller's color.
        points: Rows with their values: middle, lower end and upper end of the interval.
        has_number_axis: Whether the horizontal axis is the varied number; otherwise it is the row's number.
        x_offset: Added to the number of the row, so that controllers do not hide each other.
    """
    x_values: list[float | None] = []
    y_values: list[float] = []
    upper_errors: list[float] = []
    lower_errors: list[float] = []
    for row, (middle, lower, upper) in points:
        x_values.append(row.value if has_number_axis else row.row + x_offset)
        y_values.append(round(middle, 6))
        upper_errors.append(round(upper - middle, 6))
        lower_errors.append(round(middle - lower, 6))
    color = f"--joint-{color_index}"
    return {
        "type": "scatter",
        "mode": "lines+markers" if has_number_axis else "markers",
        "name": controller,
        "x": x_values,
        "y": y_values,
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": upper_errors,
            "arrayminus": lower_errors,
            "thickness": 1.4,
        },
        "text": [row.setting for row, _ in points],
        "hovertemplate": "%{text}: %{y:.3g}",
        "marker": {"size": 9, "color": color},
        "line": {"color": color, "width": 1.2},
    }


def _make_setting_axis(rows: Sequence[ResultRow]) -> PlotlyDict:
    """Return the x axis with the name of each setting at its number."""
    names = {row.row: row.setting for row in rows}
    return {
        "tickmode": "array",
        "tickvals": list(names),
        "ticktext": list(names.values()),
        "automargin": True,
        "range": [0.5, max(names) + 0.5],
    }

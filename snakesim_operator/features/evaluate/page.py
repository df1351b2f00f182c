"""Draws an evaluation as one page that needs no network and no other file; it looks like the report of a run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_operator.features.evaluate.condition_results import (
    ConditionResults,
    find_best_controller,
)
from snakesim_operator.features.evaluate.table import make_result_table
from snakesim_operator.results.metrics.intervals import compute_wilson_interval
from snakesim_operator.results.page.charts import PlotlyDict
from snakesim_operator.results.page.html import render_page

FIGURE_HEIGHT_PX = 300
# Part of the distance between two conditions over which the points of the controllers are spread.
CONTROLLER_SPREAD = 0.5
ValueWithInterval = tuple[float, float, float]  # middle, lower and upper end
ComputeValue = Callable[[ConditionResults], ValueWithInterval | None]


@dataclass(frozen=True)
class TrialFailure:
    """One of the worst failures, as the terminal and the page show it."""

    name: str
    reason: str
    command: str  # which repeats the trial


def render_evaluation_page(
    title: str,
    source: str,
    results: Sequence[ConditionResults],
    failures: Sequence[TrialFailure],
) -> str:
    """Return the page about an evaluation as HTML: its figures, the table of results, and the worst failures.

    Args:
        title: Heading of the page.
        source: Path of the suite file, or the command that takes the place of one.
        results: Results of each condition with each controller.
        failures: The worst failures of the best controller.
    """
    controllers = list(dict.fromkeys(row.controller for row in results))
    headings, *table_rows = make_result_table(results)
    return render_page(
        Path(__file__).parent / "evaluation.html",
        len(controllers),
        title=title,
        source=source,
        trial_count=sum(row.trial_count for row in results),
        figures=_draw_figures(results, controllers),
        has_goals=any(row.success_count is not None for row in results),
        headings=headings,
        table_rows=table_rows,
        failures=failures,
        best_controller=find_best_controller(results),
    )


def _draw_figures(
    results: Sequence[ConditionResults], controllers: Sequence[str]
) -> list[PlotlyDict | None]:
    """Draw all figures of the page; a figure is None if nothing is known about it."""
    function_by_title: dict[str, ComputeValue] = {
        "Success rate, %": _compute_success_rate_percent,
        "Speed, m/s": _make_quartile_function("advance_m_s", successful_only=True),
        "Energy, J/m": _make_quartile_function("energy_j_per_m", successful_only=True),
        "Advance, m": _make_quartile_function("advance_m"),
        "Net speed, m/s": _make_quartile_function("displacement_m_s"),
        "Net energy, J/m": _make_quartile_function("displacement_energy_j_per_m"),
        "Stalled time, s": _make_quartile_function("stalled_s"),
    }
    return [
        _draw_figure(axis_title, results, controllers, compute_value)
        for axis_title, compute_value in function_by_title.items()
    ]


def _compute_success_rate_percent(results: ConditionResults) -> ValueWithInterval | None:
    """Return the success rate with its 95 % interval, in percent; None without a goal."""
    if results.success_count is None:
        return None
    low, high = compute_wilson_interval(results.success_count, results.trial_count)
    return 100 * results.success_count / results.trial_count, 100 * low, 100 * high


def _make_quartile_function(metric: str, *, successful_only: bool = False) -> ComputeValue:
    """Return a function that computes median and quartiles of a metric over the trials; None if no value is known."""

    def compute_quartiles(results: ConditionResults) -> ValueWithInterval | None:
        values = results.list_values(metric, successful_only=successful_only)
        if not values:
            return None
        middle, lower, upper = np.percentile(values, [50, 25, 75]).tolist()
        return middle, lower, upper

    return compute_quartiles


def _draw_figure(
    axis_title: str,
    results: Sequence[ConditionResults],
    controllers: Sequence[str],
    compute_value: ComputeValue,
) -> PlotlyDict | None:
    """Draw a number of the results, with one point for each condition and one color for each controller.

    Args:
        axis_title: Title of the vertical axis.
        results: Results of each condition with each controller.
        controllers: The controllers, in the order of their colors.
        compute_value: Returns the value of one condition and controller with its interval, or None if it has no value.

    Returns:
        The figure as Plotly has it; None if there is no value. The horizontal axis is the varied number if there is
        one, and otherwise the conditions.
    """
    has_number_axis = all(row.varied_number is not None for row in results)
    traces: list[PlotlyDict] = []
    for color_index, controller in enumerate(controllers):
        points: list[tuple[ConditionResults, ValueWithInterval]] = []
        for row in results:
            if row.controller != controller:
                continue
            point = compute_value(row)
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
        x_axis |= _make_condition_axis(results)
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
    points: Sequence[tuple[ConditionResults, ValueWithInterval]],
    *,
    has_number_axis: bool,
    x_offset: float,
) -> PlotlyDict:
    """Make a Plotly trace with the points of one controller and their error bars.

    Args:
        controller: Name of the controller.
        color_index: Index of the controller's color.
        points: Results of each condition with the value: middle, lower end and upper end of the interval.
        has_number_axis: Whether the horizontal axis is the varied number; otherwise it is the number of the
            condition.
        x_offset: Added to the number of the condition, so that controllers do not hide each other.
    """
    x_values: list[float | None] = []
    y_values: list[float] = []
    upper_errors: list[float] = []
    lower_errors: list[float] = []
    for row, (middle, lower, upper) in points:
        if has_number_axis:
            x_values.append(row.varied_number)
        else:
            x_values.append(row.condition_number + x_offset)
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
        "text": [row.condition_name for row, _ in points],
        "hovertemplate": "%{text}: %{y:.3g}",
        "marker": {"size": 9, "color": color},
        "line": {"color": color, "width": 1.2},
    }


def _make_condition_axis(results: Sequence[ConditionResults]) -> PlotlyDict:
    """Return the x axis with the name of each condition at its number."""
    names = {row.condition_number: row.condition_name for row in results}
    return {
        "tickmode": "array",
        "tickvals": list(names),
        "ticktext": list(names.values()),
        "automargin": True,
        "range": [0.5, max(names) + 0.5],
    }

"""Draws an evaluation as one page that needs no network and no other file; it looks like the report of a run."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.evaluate.table import ResultRow, best_controller, known_columns, wilson_interval
from snakesim_operator.results.page.charts import Figure
from snakesim_operator.results.page.html import render

HEIGHT_PX = 300
CONTROLLER_SPREAD = 0.5  # of the distance between two settings, over which the points of the controllers are spread
Point = tuple[float, float, float]  # middle, lower and upper end
PointOf = Callable[[ResultRow], Point | None]


def render_page(title: str, source: str, rows: Sequence[ResultRow], failures: Sequence[tuple[str, str, str]]) -> str:
    """Return the page about an evaluation as HTML: its figures, the table of results, and the worst failures.

    Args:
        title: heading of the page.
        source: the suite file, or the command that stands for one.
        rows: rows of the table of results.
        failures: of the worst cases, each with its name, how it ended, and the command that runs it again.
    """
    controllers = list(dict.fromkeys(row.controller for row in rows))
    head, *cells = known_columns(rows)
    return render(
        Path(__file__).parent / "evaluation.html",
        len(controllers),
        title=title,
        about=source,
        runs=sum(row.runs for row in rows),
        figures=[
            _draw_figure("Fields crossed, %", rows, controllers, _crossed_percent),
            _draw_figure("Speed, m/s", rows, controllers, _quartiles_of("advance_m_s", of_crossed=True)),
            _draw_figure("Energy, J/m", rows, controllers, _quartiles_of("energy_j_per_m", of_crossed=True)),
            _draw_figure("Advance, m", rows, controllers, _quartiles_of("advance_m")),
            _draw_figure("Net speed, m/s", rows, controllers, _quartiles_of("displacement_m_s")),
            _draw_figure("Net energy, J/m", rows, controllers, _quartiles_of("displacement_energy_j_per_m")),
            _draw_figure("Stalled time, s", rows, controllers, _quartiles_of("stalled_s")),
        ],
        goals=any(row.crossed is not None for row in rows),
        head=head,
        rows=cells,
        worst=failures,
        best=best_controller(rows),
    )


def _crossed_percent(row: ResultRow) -> Point | None:
    """Return the success rate with its 95 % interval, in percent; None without a goal."""
    if row.crossed is None:
        return None
    low, high = wilson_interval(row.crossed, row.runs)
    return 100 * row.crossed / row.runs, 100 * low, 100 * high


def _quartiles_of(name: str, *, of_crossed: bool = False) -> PointOf:
    """Return a function that gives median and quartiles of a number of the summary; None if it is not known."""

    def quartiles(row: ResultRow) -> Point | None:
        values = row.values(name, of_crossed=of_crossed)
        if not values:
            return None
        middle, lower, upper = np.percentile(values, [50, 25, 75]).tolist()
        return middle, lower, upper

    return quartiles


def _draw_figure(axis: str, rows: Sequence[ResultRow], controllers: Sequence[str], point_of: PointOf) -> Figure | None:
    """Draw a number of the results, with one point for each row and one color for each controller.

    Args:
        axis: Title of the vertical axis.
        rows: Rows of the table of results.
        controllers: The controllers, in the order of their colors.
        point_of: Returns the value of a row with its interval, or None if the row has no value.

    Returns:
        The figure as Plotly has it; None if no row has a value. If a number is varied, it is the horizontal axis.
        Otherwise the settings are.
    """
    over_number = all(row.value is not None for row in rows)
    traces: list[Figure] = []
    for i, controller in enumerate(controllers):
        points: list[tuple[ResultRow, Point]] = []
        for row in rows:
            point = point_of(row) if row.controller == controller else None
            if point is not None:
                points.append((row, point))
        if points:
            # Controllers are drawn side by side, so that they do not hide each other.
            offset = CONTROLLER_SPREAD * ((i + 0.5) / len(controllers) - 0.5)
            traces.append(_draw_trace(controller, i, points, over_number=over_number, offset=offset))
    if not traces:
        return None
    x_axis: Figure = {"title": {"text": ""}}
    if not over_number:
        x_axis |= _setting_ticks(rows)
    layout = {
        "height": HEIGHT_PX,
        "hovermode": "closest",
        "showlegend": len(controllers) > 1,
        "xaxis": x_axis,
        "yaxis": {"title": {"text": axis}, "rangemode": "tozero"},
        "shapes": [],
        "annotations": [],
    }
    return {"label": axis, "data": traces, "layout": layout}


def _draw_trace(
    controller: str, index: int, points: Sequence[tuple[ResultRow, Point]], *, over_number: bool, offset: float
) -> Figure:
    """Return the points of one controller as a Plotly trace with error bars.

    Args:
        controller: Name of the controller.
        index: Index of its color.
        points: Rows with their values: middle, lower end and upper end of the interval.
        over_number: Whether the horizontal axis is the number that is varied. Otherwise it is the number of the row.
        offset: Added to the number of the row, so that controllers do not hide each other.
    """
    x: list[float | None] = []
    y: list[float] = []
    error_up: list[float] = []
    error_down: list[float] = []
    for row, (middle, lower, upper) in points:
        x.append(row.value if over_number else row.row + offset)
        y.append(round(middle, 6))
        error_up.append(round(upper - middle, 6))
        error_down.append(round(middle - lower, 6))
    color = f"--joint-{index}"
    return {
        "type": "scatter",
        "mode": "lines+markers" if over_number else "markers",
        "name": controller,
        "x": x,
        "y": y,
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": error_up,
            "arrayminus": error_down,
            "thickness": 1.4,
        },
        "text": [row.setting for row, _ in points],
        "hovertemplate": "%{text}: %{y:.3g}",
        "marker": {"size": 9, "color": color},
        "line": {"color": color, "width": 1.2},
    }


def _setting_ticks(rows: Sequence[ResultRow]) -> Figure:
    """Return the x axis with the name of each setting at its number."""
    names = {row.row: row.setting for row in rows}
    return {
        "tickmode": "array",
        "tickvals": list(names),
        "ticktext": list(names.values()),
        "automargin": True,
        "range": [0.5, max(names) + 0.5],
    }

"""An evaluation as one page that needs no network and no other file; it looks like a run's report."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.evaluate.table import Line, best_of, columns, wilson
from snakesim_operator.results.page.charts import Figure
from snakesim_operator.results.page.html import render

HEIGHT = 300
SPREAD = 0.5  # of the room of a setting, over which its controllers stand
Point = tuple[float, float, float]  # middle, lower and upper end


def page(title: str, about: str, lines: Sequence[Line], worst: Sequence[tuple[str, str, str]]) -> str:
    """The whole page. worst: the name of a case, why it failed, and the command that opens it."""
    controllers = list(dict.fromkeys(line.controller for line in lines))
    head, *rows = columns(lines)
    return render(
        Path(__file__).parent / "evaluation.html",
        len(controllers),
        title=title,
        about=about,
        runs=sum(line.runs for line in lines),
        figures=[
            _figure("Fields crossed, %", lines, controllers, _success),
            _figure("Speed, m/s", lines, controllers, _spread("advance_m_s", of_crossed=True)),
            _figure("Energy, J/m", lines, controllers, _spread("energy_j_per_m", of_crossed=True)),
            _figure("Advance, m", lines, controllers, _spread("advance_m")),
            _figure("Stood still, s", lines, controllers, _spread("stalled_s")),
        ],
        goals=any(line.crossed is not None for line in lines),
        head=head,
        rows=rows,
        worst=worst,
        best=best_of(lines),
    )


def _success(line: Line) -> Point | None:
    if line.crossed is None:
        return None
    low, high = wilson(line.crossed, line.runs)
    return 100 * line.crossed / line.runs, 100 * low, 100 * high


def _spread(name: str, *, of_crossed: bool = False) -> Callable[[Line], Point | None]:
    def point(line: Line) -> Point | None:
        values = line.values(name, of_crossed=of_crossed)
        return None if not values else tuple(np.percentile(values, [50, 25, 75]).tolist())

    return point


def _figure(
    axis: str, lines: Sequence[Line], controllers: Sequence[str], value: Callable[[Line], Point | None]
) -> Figure | None:
    """A point for each line, over its setting: over the number that is varied, if that is one."""
    traces: list[Figure] = []
    over_number = all(line.value is not None for line in lines)
    for i, controller in enumerate(controllers):
        known = [(line, p) for line in lines if line.controller == controller and (p := value(line)) is not None]
        aside = SPREAD * ((i + 0.5) / len(controllers) - 0.5)
        trace = {
            "type": "scatter",
            "mode": "lines+markers" if over_number else "markers",
            "name": controller,
            "x": [line.value if over_number else line.row + aside for line, _ in known],
            "y": [round(p[0], 6) for _, p in known],
            "error_y": {
                "type": "data",
                "symmetric": False,
                "array": [round(p[2] - p[0], 6) for _, p in known],
                "arrayminus": [round(p[0] - p[1], 6) for _, p in known],
                "thickness": 1.4,
            },
            "text": [line.setting for line, _ in known],
            "hovertemplate": "%{text}: %{y:.3g}",
            "marker": {"size": 9, "color": f"--joint-{i}"},
            "line": {"color": f"--joint-{i}", "width": 1.2},
        }
        traces += [trace] if known else []
    names = {line.row: line.setting for line in lines}
    ticks = {"tickmode": "array", "tickvals": list(names), "ticktext": list(names.values()), "automargin": True}
    layout = {
        "height": HEIGHT,
        "hovermode": "closest",
        "showlegend": len(controllers) > 1,
        "xaxis": {"title": {"text": ""}, **({} if over_number else {**ticks, "range": [0.5, max(names) + 0.5]})},
        "yaxis": {"title": {"text": axis}, "rangemode": "tozero"},
        "shapes": [],
        "annotations": [],
    }
    return {"label": axis, "data": traces, "layout": layout} if traces else None

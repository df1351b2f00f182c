"""The style of all figures, and lines over time."""

from typing import Any

from matplotlib.axes import Axes

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.figures.inherited import PLAIN_TEXT_STYLE
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import get_time_origin_s

FIGURE_STYLE: Any = {
    **PLAIN_TEXT_STYLE,
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "pdf.fonttype": 42,  # text stays text: journals ask for it
    "svg.fonttype": "none",
    "savefig.dpi": 300.0,
    "figure.constrained_layout.use": True,
}


def plot_over_time(
    axes: Axes, record: RunRecord, values: Floats, name: str = "", **look: str | float
) -> None:
    """Plot values, (ticks,), over the time since the first tick.

    Args:
        axes: Axes to plot into.
        record: The run, which has the times.
        values: (ticks,) values.
        name: Name in the legend.
        **look: Properties of the line, as matplotlib's `plot` takes them.
    """
    axes.plot(record.time_s - get_time_origin_s(record), values, label=name, **look)  # pyright: ignore[reportArgumentType]

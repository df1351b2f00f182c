"""The picture of an experiment: published curves as lines, and ours as points."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.features.reproduce.experiment import ExperimentPicture

SIZE_IN = (5.0, 3.2)
DPI = 110
STYLE: Any = {
    "text.usetex": False,  # LaTeX may be missing
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}
COLORS = ("#2c6fbb", "#8452a3", "#3a923a", "#d98c1f", "#2aa0a4", "#9c5a3c")
OUR_COLORS = ("#c0392b", "#d98c1f", "#2aa0a4")
OUR_MARKERS = ("o", "s", "^")


def write_picture(picture: ExperimentPicture, title: str, path: Path) -> None:
    """Write a picture as PNG.

    Args:
        picture: Curves and labels of the axes.
        title: Name of the experiment.
        path: File to write.

    Raises:
        ConfigError: The file cannot be written.
    """
    with matplotlib.rc_context(STYLE):
        figure = Figure(SIZE_IN)
        axes = figure.subplots()
        lines = [curve for curve in picture.curves if not curve.is_ours]
        points = [curve for curve in picture.curves if curve.is_ours]
        for i, curve in enumerate(lines):
            axes.plot(curve.x, curve.y, label=curve.label, color=COLORS[i % len(COLORS)])
        for i, curve in enumerate(points):
            look = i % len(OUR_COLORS)
            axes.plot(
                curve.x,
                curve.y,
                label=curve.label,
                color=OUR_COLORS[look],
                marker=OUR_MARKERS[look],
                linestyle=":",
            )
        if picture.is_logarithmic:
            axes.set(xscale="log", yscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter(FormatStrFormatter("%g"))
                axis.set_minor_formatter(NullFormatter())
        axes.set(xlabel=picture.x_label, ylabel=picture.y_label, title=title)
        axes.legend()
        with export_atomically(path) as partial:
            figure.savefig(partial, format="png", dpi=DPI, metadata={"Software": None})

"""Legends above their axes, in as many columns as fit: they never cover a curve."""

import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure

LEGEND_ROW_HEIGHT = 1.35  # of a row of a legend, in font sizes
POINTS_PER_INCH = 72.0


def place_legends(figure: Figure, all_axes: list[Axes], entries: list[list[str]]) -> None:
    """Place a legend above each pair of axes, and make the figure higher by the legends' height.

    Args:
        figure: The figure, with constrained layout.
        all_axes: The axes, from top to bottom.
        entries: Names of the legend's entries for each of the axes, in the order of the lines; empty for no legend.
    """
    added_in = 0.0
    for axes, names in zip(all_axes, entries, strict=True):
        if names:
            added_in += _place_legend(axes, names)
    figure.set_figheight(figure.get_figheight() + added_in)


def _place_legend(axes: Axes, names: list[str]) -> float:
    """Place a legend above axes, in as many columns as fit into their width, and return its height in inches."""
    handles_by_name = {str(line.get_label()): line for line in reversed(axes.lines)}
    handles = [handles_by_name[name] for name in names]
    column_count = len(names)
    while True:
        legend = axes.legend(
            handles,
            names,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=column_count,
            borderaxespad=0.2,
        )
        fits = legend.get_window_extent().width <= axes.get_window_extent().width
        if fits or column_count == 1:
            font_size_pt = legend.get_texts()[0].get_fontproperties().get_size_in_points()
            row_count = math.ceil(len(names) / column_count)
            return row_count * LEGEND_ROW_HEIGHT * font_size_pt / POINTS_PER_INCH
        column_count -= 1


def place_legend_beside_title(axes: Axes) -> None:
    """Place a legend in one row above axes, at the right, where the title at the left leaves room."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(axes.lines), borderaxespad=0.2
    )

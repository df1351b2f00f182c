"""Draws signals of one run or of several over one time axis, as lines or as means with their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.features.figures.legends import place_legends
from snakesim_operator.features.figures.run_groups import RunGroup
from snakesim_operator.results.metrics.intervals import find_mean_and_half_width
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import (
    UNITS,
    compute_signals,
    find_unit,
    make_signal_columns,
    select_columns,
)
from snakesim_operator.results.time_axis import get_time_origin_s

AXES_HEIGHT_IN = 1.5  # height of a pair of axes
DEFAULT_SIGNALS = ("angle_rad", "torque_nm")
# Of a joint's target.
MODE_BY_UNIT = {"rad": JointMode.POSITION, "rad/s": JointMode.VELOCITY, "N·m": JointMode.TORQUE}
LINE_STYLES = ("-", "--", ":", "-.")  # of the columns of one run
RUN_COLORS = (
    "#2c6fbb",
    "#c0392b",
    "#3a923a",
    "#8452a3",
    "#d98c1f",
    "#2aa0a4",
    "#9c5a3c",
    "#d45c9b",
)
MAX_TITLE_LENGTH = 18  # characters of an axis label; its unit needs room in AXES_HEIGHT_IN as well
INTERVAL_OPACITY = 0.25


@dataclass(frozen=True)
class SignalCurve:
    """One line of a figure, with the interval around it if it is a mean."""

    label: str
    time_s: Floats  # (n,) since the first tick
    values: Floats  # (n,)
    half_width: Floats | None = None  # (n,) of the 95 % confidence interval
    color: Any = None
    line_style: str = "-"


class RunSignals:
    """The columns of one run, computed once for all axes."""

    def __init__(self, record: RunRecord) -> None:
        self.record = record
        self.columns = make_signal_columns(record)
        self.time_s = record.time_s - get_time_origin_s(record)

    def find_unit(self, name: str) -> str:
        """Return the unit of a signal, of a column or of several columns."""
        return find_unit(name, self.record)

    def select_columns_of_unit(self, name: str, unit: str) -> dict[str, NDArray[Any]]:
        """Return the columns of a signal. Targets whose mode has another unit are NaN."""
        columns = select_columns(name, self.columns)
        return {
            column: self._mask_other_units(column, values, unit)
            for column, values in columns.items()
        }

    def _mask_other_units(self, column: str, values: NDArray[Any], unit: str) -> NDArray[Any]:
        """Return the values of a column, with NaN for targets whose mode has another unit."""
        if not column.startswith("target.") or unit not in MODE_BY_UNIT:
            return values
        names = [joint.name for joint in self.record.description.joints]
        joint = names.index(column.partition(".")[2])
        return np.where(self.record.mode[:, joint] == MODE_BY_UNIT[unit], values, np.nan)


def draw_signals(
    groups: Sequence[RunGroup], names: Sequence[str], width_in: float, span_s: tuple[float, float]
) -> Figure:
    """Draw signals of one or several runs over a common time axis.

    Args:
        groups: The runs. A group of several is drawn as the mean over its runs with the mean's 95 % interval.
        names: One name for each pair of axes, or several that a comma joins, such as "angle_rad.joint_1,target".
        width_in: Width of the figure in inches.
        span_s: Begin and end of the part of the runs to draw, in s on the time axis.

    Raises:
        ConfigError: There is no such signal, signals of different units share axes, or the span is empty.
    """
    names = names or DEFAULT_SIGNALS
    signals_by_group = [[RunSignals(record) for record in group.records] for group in groups]
    figure = Figure((width_in, AXES_HEIGHT_IN * len(names) + 0.3))
    all_axes: list[Axes] = list(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    legend_entries: list[list[str]] = []
    for axes, joined_names in zip(all_axes, names, strict=True):
        legend_entries.append(
            _plot_signals(axes, groups, signals_by_group, joined_names.split(","))
        )
    _set_time_limits(all_axes[-1], groups, span_s)
    place_legends(figure, all_axes, legend_entries)
    return figure


def _plot_signals(
    axes: Axes,
    groups: Sequence[RunGroup],
    signals_by_group: Sequence[Sequence[RunSignals]],
    names: Sequence[str],
) -> list[str]:
    """Plot signals over time into one pair of axes.

    Args:
        axes: The axes to plot into.
        groups: The runs.
        signals_by_group: Signals of each run of each group, in the order of `groups`; there is at least one run.
        names: Names of signals with a common unit. A signal with several columns gets one line for each column.

    Returns:
        The entries of the legend; empty for a single line.

    Raises:
        ConfigError: There is no such signal, or the units differ.
    """
    for name in names:
        _validate_signal_name(name, signals_by_group)
    unit = _find_common_unit(names, signals_by_group[0][0])
    curves: list[SignalCurve] = []
    # Several groups have a color each. In a single group, each curve gets the next color of the cycle below.
    for i, (group, runs) in enumerate(zip(groups, signals_by_group, strict=True)):
        color = RUN_COLORS[i % len(RUN_COLORS)] if len(groups) > 1 else None
        curves += _make_curves(group, runs, names, unit, color)
    if len(groups) == 1 and len(names) == 1 and len(curves) > 1:
        axes.set_prop_cycle(color=colormaps["turbo"](np.linspace(0.05, 0.95, len(curves))))
    for curve in curves:
        _plot_curve(axes, curve)
    title = names[0] if len(names) == 1 else ""
    axes.set_ylabel(_make_axis_label(title, unit))
    labels = list(dict.fromkeys(curve.label for curve in curves))
    # A single mean curve has a legend, too, because its label names the group of runs.
    has_mean_curve = any(len(group.records) > 1 for group in groups)
    return labels if len(labels) > 1 or has_mean_curve else []


def _make_curves(
    group: RunGroup, runs: Sequence[RunSignals], names: Sequence[str], unit: str, color: str | None
) -> list[SignalCurve]:
    """Return a curve for each column of the signals.

    Args:
        group: The runs that are drawn as one.
        runs: Columns of these runs.
        names: Names of the signals.
        unit: Common unit of the signals.
        color: Color of the group; None if each curve has its own color, and the label does not name the group.
    """
    values_by_column: dict[str, list[tuple[RunSignals, Floats]]] = {}
    for run in runs:
        for name in names:
            for column, values in run.select_columns_of_unit(name, unit).items():
                values_by_column.setdefault(column, []).append(
                    (run, np.asarray(values, dtype=float))
                )
    curves: list[SignalCurve] = []
    for i, (column, runs_with_values) in enumerate(values_by_column.items()):
        label = _label_column(column, names)
        line_style = "-"
        if color is not None:
            is_whole_signal = len(names) == 1 and len(values_by_column) > 1
            label = (
                group.label
                if is_whole_signal or len(values_by_column) == 1
                else f"{group.label}: {label}"
            )
            line_style = "-" if is_whole_signal else LINE_STYLES[i % len(LINE_STYLES)]
        elif len(group.records) > 1:
            label = f"{label}, {group.label}"
        curves.append(_make_curve(group, runs_with_values, label, color, line_style))
    return curves


def _make_curve(
    group: RunGroup,
    runs_with_values: Sequence[tuple[RunSignals, Floats]],
    label: str,
    color: str | None,
    line_style: str,
) -> SignalCurve:
    """Return the curve of one column: of a run, or the mean over the runs of a group at the times of the first run."""
    first_run, values = runs_with_values[0]
    if len(runs_with_values) == 1:
        return SignalCurve(label, first_run.time_s, values, color=color, line_style=line_style)
    time_s = first_run.time_s[first_run.time_s <= group.end_s + 1e-9]
    samples = [
        _sample_nearest(time_s, run.time_s, run_values) for run, run_values in runs_with_values
    ]
    mean, half_width = find_mean_and_half_width(np.array(samples))
    return SignalCurve(label, time_s, mean, half_width, color, line_style)


def _sample_nearest(time_s: Floats, own_time_s: Floats, values: Floats) -> Floats:
    """Return the values of the rows that are next to the times, (n,). Runs of one configuration have equal ticks."""
    after = (
        np.clip(np.searchsorted(own_time_s, time_s), 1, len(own_time_s) - 1)
        if len(own_time_s) > 1
        else 0
    )
    before = np.maximum(np.asarray(after) - 1, 0)
    is_nearer_before = time_s - own_time_s[before] <= own_time_s[after] - time_s
    return values[np.where(is_nearer_before, before, after)]


def _plot_curve(axes: Axes, curve: SignalCurve) -> None:
    (line,) = axes.plot(
        curve.time_s, curve.values, label=curve.label, color=curve.color, linestyle=curve.line_style
    )
    if curve.half_width is not None:
        axes.fill_between(
            curve.time_s,
            curve.values - curve.half_width,
            curve.values + curve.half_width,
            color=line.get_color(),
            alpha=INTERVAL_OPACITY,
            linewidth=0,
        )


def _make_axis_label(title: str, unit: str) -> str:
    """Return the label of a vertical axis; the unit of a long one is on a line of its own."""
    if unit == "1":
        return title
    separator = "\n" if len(title) > MAX_TITLE_LENGTH else " "
    return f"{title}{separator}[{unit}]".strip()


def _label_column(column: str, names: Sequence[str]) -> str:
    """Return what the legend calls a column: its part alone, unless it was asked for by its whole name."""
    for name in names:
        if column.startswith(f"{name}."):
            return column.partition(".")[2]
    return column


def _validate_signal_name(name: str, signals: Sequence[Sequence[RunSignals]]) -> None:
    """Raise ConfigError for a signal that no run has."""
    runs = [run for group in signals for run in group]
    if any(select_columns(name, run.columns) for run in runs):
        return
    first = runs[0].record
    wide = ", ".join(array for array in compute_signals(first) if array != "time_s")
    known: Mapping[str, Any] = {**compute_signals(first), **runs[0].columns}
    raise ConfigError(
        f"no signal {shorten(name)!r}; {suggest_word(name, list(known))}there are {wide}, and "
        f"columns of them such as angle_rad.{first.description.joints[0].name}",
        code="recording/unknown-signal",
    )


def _find_common_unit(names: Sequence[str], run: RunSignals) -> str:
    """Return the unit of signals that share axes. Raises ConfigError when they have several.

    Targets have a unit for each mode. Beside other signals they are drawn where their mode has the others' unit.
    """
    units = {run.find_unit(name) for name in names}
    if len(units) > 1:
        units.discard(UNITS["target"])
    if len(units) > 1:
        raise ConfigError(
            f"{','.join(names)}: {' and '.join(sorted(units))} have no axis in common; leave a space",
            code="command/invalid-option",
        )
    (unit,) = units
    return unit


def _set_time_limits(axes: Axes, groups: Sequence[RunGroup], span_s: tuple[float, float]) -> None:
    """Limit the time axis to a span. Raises ConfigError for a span without data."""
    records = [record for group in groups for record in group.records]
    last_s = max(float(record.time_s[-1]) - get_time_origin_s(record) for record in records)
    start_s = span_s[0]
    end_s = min(span_s[1], last_s)
    if start_s >= end_s:
        span = f"--from {span_s[0]:g} --to {span_s[1]:g}"
        runs_text = "this run" if len(records) == 1 else "these runs"
        raise ConfigError(
            f"{span}: give a span, its begin first, within the 0 to {last_s:g} s of {runs_text}",
            code="command/invalid-option",
        )
    axes.set_xlim(start_s, end_s)
    axes.set_xlabel("time [s]")

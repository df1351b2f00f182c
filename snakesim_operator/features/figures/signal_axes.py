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
from snakesim_hal.wire.messages import Mode
from snakesim_operator.features.figures.legends import place_legends
from snakesim_operator.features.figures.run_groups import RunGroup
from snakesim_operator.results.metrics.intervals import find_mean_and_half_width
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import UNITS, arrays, select_columns, table, unit_of
from snakesim_operator.results.time_axis import zero_s

AXES_IN = 1.5  # height of a pair of axes
DEFAULT_SIGNALS = ("angle_rad", "torque_nm")
MODE_OF_UNIT = {"rad": Mode.POSITION, "rad/s": Mode.VELOCITY, "N·m": Mode.TORQUE}  # of a joint's target
LINE_STYLES = ("-", "--", ":", "-.")  # of the columns of one run
RUN_COLORS = ("#2c6fbb", "#c0392b", "#3a923a", "#8452a3", "#d98c1f", "#2aa0a4", "#9c5a3c", "#d45c9b")
MAX_TITLE_LENGTH = 18  # characters of an axis label; its unit needs room in AXES_IN as well
INTERVAL_OPACITY = 0.25


@dataclass(frozen=True)
class Curve:
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
        self.columns = table(record)
        self.time_s = record.time_s - zero_s(record)

    def find_unit(self, name: str) -> str:
        """Return the unit of a signal, of a column or of several columns."""
        return unit_of(name, self.record)

    def select(self, name: str, unit: str) -> dict[str, NDArray[Any]]:
        """Return the columns of a signal. Targets whose mode has another unit are NaN."""
        columns = select_columns(name, self.columns)
        return {column: self._keep_unit(column, values, unit) for column, values in columns.items()}

    def _keep_unit(self, column: str, values: NDArray[Any], unit: str) -> NDArray[Any]:
        """Return the values of a column, with NaN for targets whose mode has another unit."""
        if not column.startswith("target.") or unit not in MODE_OF_UNIT:
            return values
        names = [joint.name for joint in self.record.description.joints]
        joint = names.index(column.partition(".")[2])
        return np.where(self.record.mode[:, joint] == MODE_OF_UNIT[unit], values, np.nan)


def draw_signals(
    groups: Sequence[RunGroup], names: Sequence[str], width_in: float, span_s: tuple[float, float]
) -> Figure:
    """Draw signals over one time axis.

    Args:
        groups: The runs. A group of several is drawn as the mean over its runs with the mean's 95 % interval.
        names: One name for each pair of axes, or several that a comma joins, such as "angle_rad.joint_1,target".
        width_in: Width of the figure in inches.
        span_s: Begin and end of the part of the runs to draw, in s on the time axis.

    Raises:
        ConfigError: There is no such signal, signals of different units share axes, or the span is empty.
    """
    names = names or DEFAULT_SIGNALS
    signals = [[RunSignals(record) for record in group.records] for group in groups]
    figure = Figure((width_in, AXES_IN * len(names) + 0.3))
    all_axes: list[Axes] = list(figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0])
    entries: list[list[str]] = []
    for axes, joined_names in zip(all_axes, names, strict=True):
        entries.append(_plot_signals(axes, groups, signals, joined_names.split(",")))
    _limit_time(all_axes[-1], groups, span_s)
    place_legends(figure, all_axes, entries)
    return figure


def _plot_signals(
    axes: Axes, groups: Sequence[RunGroup], signals: Sequence[Sequence[RunSignals]], names: Sequence[str]
) -> list[str]:
    """Plot signals over time into one pair of axes.

    Args:
        axes: The axes to plot into.
        groups: The runs.
        signals: The columns of each run of each group.
        names: Names of signals with a common unit. A signal with several columns gets one line for each column.

    Returns:
        The entries of the legend; empty for a single line.

    Raises:
        ConfigError: There is no such signal, or the units differ.
    """
    for name in names:
        _check_known(name, signals)
    unit = _find_common_unit(names, signals[0][0])
    curves: list[Curve] = []
    for i, (group, runs) in enumerate(zip(groups, signals, strict=True)):
        color = RUN_COLORS[i % len(RUN_COLORS)] if len(groups) > 1 else None
        curves += _make_curves(group, runs, names, unit, color)
    if len(groups) == 1 and len(names) == 1 and len(curves) > 1:
        axes.set_prop_cycle(color=colormaps["turbo"](np.linspace(0.05, 0.95, len(curves))))
    for curve in curves:
        _plot_curve(axes, curve)
    title = names[0] if len(names) == 1 else ""
    axes.set_ylabel(_make_axis_label(title, unit))
    labels = list(dict.fromkeys(curve.label for curve in curves))
    is_mean = any(len(group.records) > 1 for group in groups)
    return labels if len(labels) > 1 or is_mean else []


def _make_curves(
    group: RunGroup, runs: Sequence[RunSignals], names: Sequence[str], unit: str, color: str | None
) -> list[Curve]:
    """Return a curve for each column of the signals.

    Args:
        group: The runs that are drawn as one.
        runs: Their columns.
        names: Names of the signals.
        unit: Their unit.
        color: Color of the group; None: each curve has its own, and the group is not part of the label.
    """
    columns: dict[str, list[tuple[RunSignals, Floats]]] = {}
    for run in runs:
        for name in names:
            for column, values in run.select(name, unit).items():
                columns.setdefault(column, []).append((run, np.asarray(values, dtype=float)))
    curves: list[Curve] = []
    for i, (column, found) in enumerate(columns.items()):
        label = _label_column(column, names)
        line_style = "-"
        if color is not None:
            is_whole_signal = len(names) == 1 and len(columns) > 1
            label = group.label if is_whole_signal or len(columns) == 1 else f"{group.label}: {label}"
            line_style = "-" if is_whole_signal else LINE_STYLES[i % len(LINE_STYLES)]
        elif len(group.records) > 1:
            label = f"{label}, {group.label}"
        curves.append(_make_curve(group, found, label, color, line_style))
    return curves


def _make_curve(
    group: RunGroup, found: Sequence[tuple[RunSignals, Floats]], label: str, color: str | None, line_style: str
) -> Curve:
    """Return the curve of one column: of a run, or the mean over the runs of a group at the times of the first run."""
    first, values = found[0]
    if len(found) == 1:
        return Curve(label, first.time_s, values, color=color, line_style=line_style)
    time_s = first.time_s[first.time_s <= group.end_s + 1e-9]
    samples = [_sample_at(time_s, run.time_s, run_values) for run, run_values in found]
    mean, half_width = find_mean_and_half_width(np.array(samples))
    return Curve(label, time_s, mean, half_width, color, line_style)


def _sample_at(time_s: Floats, own_time_s: Floats, values: Floats) -> Floats:
    """Return the values of the rows that are next to the times, (n,). Runs of one configuration have equal ticks."""
    after = np.clip(np.searchsorted(own_time_s, time_s), 1, len(own_time_s) - 1) if len(own_time_s) > 1 else 0
    before = np.maximum(np.asarray(after) - 1, 0)
    is_nearer_before = time_s - own_time_s[before] <= own_time_s[after] - time_s
    return values[np.where(is_nearer_before, before, after)]


def _plot_curve(axes: Axes, curve: Curve) -> None:
    (line,) = axes.plot(curve.time_s, curve.values, label=curve.label, color=curve.color, linestyle=curve.line_style)
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


def _check_known(name: str, signals: Sequence[Sequence[RunSignals]]) -> None:
    """Raise ConfigError for a signal that no run has."""
    runs = [run for group in signals for run in group]
    if any(select_columns(name, run.columns) for run in runs):
        return
    first = runs[0].record
    wide = ", ".join(array for array in arrays(first) if array != "time_s")
    known: Mapping[str, Any] = {**arrays(first), **runs[0].columns}
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


def _limit_time(axes: Axes, groups: Sequence[RunGroup], span_s: tuple[float, float]) -> None:
    """Limit the time axis to a span. Raises ConfigError for a span without data."""
    records = [record for group in groups for record in group.records]
    last_s = max(float(record.time_s[-1]) - zero_s(record) for record in records)
    start_s = span_s[0]
    end_s = min(span_s[1], last_s)
    if start_s >= end_s:
        span = f"--from {span_s[0]:g} --to {span_s[1]:g}"
        whose = "this run" if len(records) == 1 else "these runs"
        raise ConfigError(
            f"{span}: give a span, its begin first, within the 0 to {last_s:g} s of {whose}",
            code="command/invalid-option",
        )
    axes.set_xlim(start_s, end_s)
    axes.set_xlabel("time [s]")

"""Draws signals of a run over time for a paper, and writes figures to files."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.textfiles import exported
from snakesim_hal.wire.messages import Mode
from snakesim_operator.features.figures.from_above import draw_paths
from snakesim_operator.features.figures.lines import STYLE, Floats, plot_over_time
from snakesim_operator.features.figures.paper import draw_paper_figures
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import UNITS, arrays, table, unit_of
from snakesim_operator.results.time_axis import zero_s

FORMATS = (".pdf", ".svg", ".png")
AXES_IN = 1.5  # height of a pair of axes
DEFAULT_SIGNALS = ("angle_rad", "torque_nm")
MODE_OF_UNIT = {"rad": Mode.POSITION, "rad/s": Mode.VELOCITY, "N·m": Mode.TORQUE}  # of a joint's target
MAX_LINES_WITH_LEGEND_INSIDE = 6  # with more lines, the legend is beside the axes


def plot(
    run: Path,
    names: Sequence[str],
    out: Path | None,
    *,
    paper: bool,
    path: bool,
    width_in: float,
    span_s: tuple[float, float],
    dark: bool,
) -> int:
    """Draw signals of a run, its path, or the figures of the paper, and write them to files.

    Args:
        run: Folder or file of the run.
        names: Signals, as `draw_signals` takes them.
        out: File to write, or with `paper` the folder; None writes into the run's folder.
        paper: Draw the figures of the paper instead of signals.
        path: Draw the paths of head and tail from above instead of signals.
        width_in: Width of a figure in inches.
        span_s: Begin and end of the part of the run to draw, in s on the time axis.
        dark: Draw on a dark background.

    Returns:
        The exit code: 0, or 3 when a part of the recording is missing.

    Raises:
        ConfigError: Nothing was recorded, or a name, the span or the path is wrong.
    """
    record = RunRecord.load(run)
    if not len(record.time_s):
        raise ConfigError(f"{run}: nothing was recorded in it; the robot was never armed", code="recording/never-armed")
    folder = run if run.is_dir() else run.parent
    style = ["dark_background", STYLE] if dark else STYLE
    with matplotlib.style.context(style):
        if paper:
            _write_paper_figures(record, out or folder, width_in, span_s)
        else:
            file = out or folder / ("path.pdf" if path else "plot.pdf")
            if file.suffix not in FORMATS:
                raise ConfigError(
                    f"--out {file}: give a file that ends in {', '.join(FORMATS)}", code="command/invalid-option"
                )
            figure = draw_paths(record, width_in, span_s) if path else draw_signals(record, names, width_in, span_s)
            write_figure(figure, file)
    return exit_code(run, record.missing)


def _write_paper_figures(record: RunRecord, folder: Path, width_in: float, span_s: tuple[float, float]) -> None:
    if folder.suffix in FORMATS:
        raise ConfigError(
            f"--out {folder}: the paper's figures are several files; give a folder", code="command/invalid-option"
        )
    for name, figure in draw_paper_figures(record, width_in, span_s).items():
        write_figure(figure, folder / f"{name}.pdf")


def draw_signals(record: RunRecord, names: Sequence[str], width_in: float, span_s: tuple[float, float]) -> Figure:
    """Draw signals over one time axis.

    Args:
        record: What was recorded of the run.
        names: One name for each pair of axes, or several that a comma joins, such as "angle_rad.joint_1,target".
        width_in: Width of the figure in inches.
        span_s: Begin and end of the part of the run to draw, in s on the time axis.

    Raises:
        ConfigError: There is no such signal, signals of different units share axes, or the span is empty.
    """
    names = names or DEFAULT_SIGNALS
    figure = Figure((width_in, AXES_IN * len(names) + 0.3))
    all_axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, joined_names in zip(all_axes, names, strict=True):
        _plot_signals(axes, record, joined_names.split(","))
    _limit_time(all_axes[-1], record, span_s)
    return figure


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file in the format of its suffix, and print the path. Raises ConfigError."""
    content = io.BytesIO()  # matplotlib's PDF writer raises errors of its own after one of the disk
    figure.savefig(content, format=path.suffix[1:])
    with exported(path) as partial:
        partial.write_bytes(content.getvalue())
    print_line(f"written: {path}")


def _plot_signals(axes: Axes, record: RunRecord, names: Sequence[str]) -> None:
    """Plot signals over time into one pair of axes.

    Args:
        axes: The axes to plot into.
        record: What was recorded of the run.
        names: Names of signals with a common unit. A signal with several columns gets one line for each column.

    Raises:
        ConfigError: There is no such signal, or the units differ.
    """
    columns = table(record)
    signals = {**arrays(record), **columns}
    for name in names:
        _check_known(name, signals, record)
    unit = _find_common_unit(names, record)
    if len(names) == 1 and signals[names[0]].ndim > 1:
        count = signals[names[0]].shape[1]
        axes.set_prop_cycle(color=colormaps["turbo"](np.linspace(0.05, 0.95, count)))
    for name in names:
        columns_of_signal = [column for column in columns if column.startswith(f"{name}.")]
        for column in (name, *columns_of_signal):
            values = signals[column]
            if values.ndim > 1:
                continue  # its columns are drawn instead
            if column.startswith("target"):
                values = _keep_targets_of_unit(record, column, values, unit)
            label = column if name == column else column.partition(".")[2]
            plot_over_time(axes, record, values, label)
    title = names[0] if len(names) == 1 else ""
    has_unit = unit != "1"
    axes.set_ylabel(f"{title} [{unit}]".strip() if has_unit else title)
    _add_legend(axes)


def _check_known(name: str, known: Mapping[str, Any], record: RunRecord) -> None:
    """Raise ConfigError for a signal that does not exist."""
    if name in known:
        return
    wide = ", ".join(array for array in arrays(record) if array != "time_s")
    raise ConfigError(
        f"no signal {shorten(name)!r}; {suggest_word(name, list(known))}there are {wide}, and columns of them "
        f"such as angle_rad.{record.description.joints[0].name}",
        code="recording/unknown-signal",
    )


def _find_common_unit(names: Sequence[str], record: RunRecord) -> str:
    """Return the unit of signals that share axes. Raises ConfigError when they have several.

    Targets have a unit for each mode. Beside other signals they are drawn where their mode has the others' unit.
    """
    units = {unit_of(name, record) for name in names}
    if len(units) > 1:
        units.discard(UNITS["target"])
    if len(units) > 1:
        raise ConfigError(
            f"{','.join(names)}: {' and '.join(sorted(units))} have no axis in common; leave a space",
            code="command/invalid-option",
        )
    (unit,) = units
    return unit


def _keep_targets_of_unit(record: RunRecord, column: str, values: Floats, unit: str) -> Floats:
    """Return the targets of a joint, (ticks,), with NaN where the mode has another unit.

    If `unit` is not that of a single mode, all targets are returned.
    """
    if unit not in MODE_OF_UNIT:
        return values
    names = [joint.name for joint in record.description.joints]
    joint = names.index(column.partition(".")[2])
    return np.where(record.mode[:, joint] == MODE_OF_UNIT[unit], values, np.nan)


def _add_legend(axes: Axes) -> None:
    count = len(axes.lines)
    if count > MAX_LINES_WITH_LEGEND_INSIDE:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1 + count // 14, fontsize=5.0)
    elif count > 1:
        axes.legend(loc="best")


def _limit_time(axes: Axes, record: RunRecord, span_s: tuple[float, float]) -> None:
    """Limit the time axis to a span. Raises ConfigError for a span without data."""
    last_s = float(record.time_s[-1]) - zero_s(record)
    start_s = span_s[0]
    end_s = min(span_s[1], last_s)
    if start_s >= end_s:
        span = f"--from {span_s[0]:g} --to {span_s[1]:g}"
        raise ConfigError(
            f"{span}: give a span, its begin first, within the 0 to {last_s:g} s of this run",
            code="command/invalid-option",
        )
    axes.set_xlim(start_s, end_s)
    axes.set_xlabel("time [s]")

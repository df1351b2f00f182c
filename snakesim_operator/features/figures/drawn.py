"""Signals of a run over time, as a figure for a paper; and the files that figures are written to."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snakesim_hal.base.errors import ConfigError, did_you_mean, short
from snakesim_hal.base.terminal import say
from snakesim_hal.model.textfiles import exported
from snakesim_hal.wire.messages import Mode
from snakesim_operator.features.figures.lines import STYLE, Floats, over_time
from snakesim_operator.features.figures.paper import figures
from snakesim_operator.playback.export import UNITS, arrays, table, unit_of
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.time_axis import zero_s

FORMATS = (".pdf", ".svg", ".png")
AXES_IN = 1.5  # height of a pair of axes
MODE_OF = {"rad": Mode.POSITION, "rad/s": Mode.VELOCITY, "N·m": Mode.TORQUE}  # by the unit of its target
MANY = 6  # lines, from which on the legend stands beside the axes


def plot(
    run: Path,
    names: Sequence[str],
    out: Path | None,
    *,
    paper: bool,
    width_in: float,
    span_s: tuple[float, float],
    dark: bool,
) -> int:
    """Draw signals, or the paper's figures. Returns 0, or 3 when the recording lacks something. Raises ConfigError."""
    record = RunRecord.load(run)
    if not len(record.time_s):
        raise ConfigError(f"{run}: nothing was recorded in it; the robot was never armed")
    within = run if run.is_dir() else run.parent
    path = out or (within if paper else within / "plot.pdf")
    with matplotlib.style.context(["dark_background", STYLE] if dark else STYLE):
        if paper:
            if path.suffix in FORMATS:
                raise ConfigError(f"--out {path}: the paper's figures are several files; give a folder")
            for name, figure in figures(record, width_in, span_s).items():
                written(figure, path / f"{name}.pdf")
        else:
            if path.suffix not in FORMATS:
                raise ConfigError(f"--out {path}: give a file that ends in {', '.join(FORMATS)}")
            written(signals(record, names, width_in, span_s), path)
    return exit_code(run, record.lacks)


def signals(record: RunRecord, names: Sequence[str], width_in: float, span_s: tuple[float, float]) -> Figure:
    """A pair of axes for each name, or for several that a comma joins; over one time axis. Raises ConfigError."""
    names = names or ("angle_rad", "torque_nm")
    figure = Figure((width_in, AXES_IN * len(names) + 0.3))
    every = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, given in zip(every, names, strict=True):
        _draw(axes, record, given.split(","))
    _limit(every[-1], record, span_s)
    return figure


def written(figure: Figure, path: Path) -> None:
    """Save it, and say where. Raises ConfigError."""
    content = io.BytesIO()  # matplotlib's PDF writer raises errors of its own after one of the disk
    figure.savefig(content, format=path.suffix[1:])
    with exported(path) as partial:
        partial.write_bytes(content.getvalue())
    say(f"written: {path}")


def _draw(axes: Axes, record: RunRecord, names: Sequence[str]) -> None:
    known = {**arrays(record), **table(record)}
    for name in names:
        if name not in known:
            wide = ", ".join(name for name in arrays(record) if name != "time_s")
            raise ConfigError(
                f"no signal {short(name)!r}; {did_you_mean(name, list(known))}there are {wide}, and columns of them "
                f"such as angle_rad.{record.description.joints[0].name}"
            )
    units = {unit_of(name, record) for name in names}
    if len(units) > 1:
        units.discard(UNITS["target"])  # drawn where its mode has the unit of the others
    if len(units) > 1:
        raise ConfigError(f"{','.join(names)}: {' and '.join(sorted(units))} have no axis in common; leave a space")
    (unit,) = units
    if len(names) == 1 and known[names[0]].ndim > 1:
        axes.set_prop_cycle(color=colormaps["turbo"](np.linspace(0.05, 0.95, known[names[0]].shape[1])))
    for name in names:
        columns = {key: known[key] for key in (name, *table(record)) if key == name or key.startswith(f"{name}.")}
        for column, values in columns.items():
            if values.ndim == 1:
                shown = _of_unit(record, column, values, unit) if column.startswith("target") else values
                over_time(axes, record, shown, column if name == column else column.partition(".")[2])
    label = names[0] if len(names) == 1 else ""
    axes.set_ylabel(label if unit == "1" else f"{label} [{unit}]".strip())
    if (count := len(axes.lines)) > MANY:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1 + count // 14, fontsize=5.0)
    elif count > 1:
        axes.legend(loc="best")


def _of_unit(record: RunRecord, column: str, values: Floats, unit: str) -> Floats:
    """A target, (ticks,), where it is one of this unit; all of it for the unit of all modes."""
    if unit not in MODE_OF:
        return values
    joint = [joint.name for joint in record.description.joints].index(column.partition(".")[2])
    return np.where(record.mode[:, joint] == MODE_OF[unit], values, np.nan)


def _limit(axes: Axes, record: RunRecord, span_s: tuple[float, float]) -> None:
    last_s = float(record.time_s[-1]) - zero_s(record)
    if span_s[0] >= min(span_s[1], last_s):
        asked = f"--from {span_s[0]:g} --to {span_s[1]:g}"
        raise ConfigError(f"{asked}: give a span, its begin first, within the 0 to {last_s:g} s of this run")
    axes.set_xlim(span_s[0], min(span_s[1], last_s))
    axes.set_xlabel("time [s]")

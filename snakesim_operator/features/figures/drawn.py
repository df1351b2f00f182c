"""Draws figures of recorded runs for a paper, and writes them to files."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.style
from matplotlib.figure import Figure

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.textfiles import exported
from snakesim_operator.features.figures.from_above import draw_paths
from snakesim_operator.features.figures.lines import STYLE
from snakesim_operator.features.figures.paper import draw_paper_figures
from snakesim_operator.features.figures.run_groups import (
    RunGroup,
    group_by_seed,
    load_runs,
    make_single_groups,
    split_arguments,
)
from snakesim_operator.features.figures.signal_axes import draw_signals
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.run_log import RunRecord

FORMATS = (".pdf", ".svg", ".png")


def plot(
    arguments: Sequence[str],
    out: Path | None,
    *,
    mean: bool,
    paper: bool,
    path: bool,
    width_in: float,
    span_s: tuple[float, float],
    dark: bool,
) -> int:
    """Draw signals of runs, the path of a run, or the figures of the paper, and write them to files.

    Args:
        arguments: Folders or files of runs, then signals as `draw_signals` takes them.
        out: File to write, or with `paper` the folder; None writes into the first run's folder.
        mean: Draw runs that differ in their seeds alone as their mean, with its 95 % confidence interval.
        paper: Draw the figures of the paper instead of signals.
        path: Draw the paths of head and tail from above instead of signals.
        width_in: Width of a figure in inches.
        span_s: Begin and end of the part of the runs to draw, in s on the time axis.
        dark: Draw on a dark background.

    Returns:
        The exit code: 0, or 3 when a part of a recording is missing.

    Raises:
        ConfigError: Nothing was recorded, or a name, an option, the span or the path is wrong.
    """
    runs, names = split_arguments(arguments)
    _check_options(runs, names, mean=mean, from_one_run=paper or path)
    records = load_runs(runs)
    folder = runs[0] if runs[0].is_dir() else runs[0].parent
    style = ["dark_background", STYLE] if dark else STYLE
    with matplotlib.style.context(style):
        if paper:
            _write_paper_figures(records[0], out or folder, width_in, span_s)
        else:
            file = out or folder / ("path.pdf" if path else "plot.pdf")
            if file.suffix not in FORMATS:
                raise ConfigError(
                    f"--out {file}: give a file that ends in {', '.join(FORMATS)}", code="command/invalid-option"
                )
            if path:
                figure = draw_paths(records[0], width_in, span_s)
            else:
                figure = draw_signals(_make_groups(records, mean=mean), names, width_in, span_s)
            write_figure(figure, file)
    return max(exit_code(run, record.missing) for run, record in zip(runs, records, strict=True))


def _check_options(runs: Sequence[Path], names: Sequence[str], *, mean: bool, from_one_run: bool) -> None:
    """Raise ConfigError for options that do not fit together."""
    if from_one_run and (len(runs) > 1 or names or mean):
        raise ConfigError(
            "--path and --paper draw one run, without signals and --mean; give one run, or leave them out",
            code="command/conflicting-options",
        )
    if mean and len(runs) == 1:
        raise ConfigError(
            "--mean: one run has no mean; give several runs that differ in their seeds", code="command/invalid-option"
        )


def _make_groups(records: Sequence[RunRecord], *, mean: bool) -> list[RunGroup]:
    """Return what is drawn as one line each, and print over which time the means are."""
    if not mean:
        return make_single_groups(records)
    groups = group_by_seed(records)
    for group in groups:
        if len(group.records) > 1:
            shortest = min(group.records, key=lambda record: record.time_s[-1] - record.time_s[0])
            print_line(
                f"{group.label}, with its 95 % interval by Student's t; until {group.end_s:.2f} s, the end of "
                f"{shortest.folder}"
            )
    return groups


def _write_paper_figures(record: RunRecord, folder: Path, width_in: float, span_s: tuple[float, float]) -> None:
    if folder.suffix in FORMATS:
        raise ConfigError(
            f"--out {folder}: the paper's figures are several files; give a folder", code="command/invalid-option"
        )
    for name, figure in draw_paper_figures(record, width_in, span_s).items():
        write_figure(figure, folder / f"{name}.pdf")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file in the format of its suffix, and print the path. Raises ConfigError."""
    content = io.BytesIO()  # matplotlib's PDF writer raises errors of its own after one of the disk
    figure.savefig(content, format=path.suffix[1:])
    with exported(path) as partial:
        partial.write_bytes(content.getvalue())
    print_line(f"written: {path}")

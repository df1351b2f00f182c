"""Draws figures of recorded runs for a paper, and writes them to files."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.style
from matplotlib.figure import Figure

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.features.figures.from_above import draw_head_and_tail_paths
from snakesim_operator.features.figures.lines import FIGURE_STYLE
from snakesim_operator.features.figures.paper import draw_paper_figures
from snakesim_operator.features.figures.run_groups import (
    RunGroup,
    group_runs_by_configuration,
    load_armed_runs,
    make_single_run_groups,
    split_runs_and_signals,
)
from snakesim_operator.features.figures.signal_axes import draw_signals
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.run_log import RunRecord

FILE_SUFFIXES = (".pdf", ".svg", ".png")


def plot_runs(
    arguments: Sequence[str],
    output_path: Path | None,
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
        output_path: File to write, or with `paper` the folder; None for the folder of the first run.
        mean: Whether to draw runs that differ in their seeds alone as their mean, with its 95 % confidence interval.
        paper: Whether to draw the figures of the SnakeSIM paper instead of signals.
        path: Whether to draw the paths of head and tail from above instead of signals.
        width_in: Width of a figure in inches.
        span_s: Begin and end of the part of the runs to draw, in s on the time axis.
        dark: Whether to draw on a dark background.

    Returns:
        The exit code: 0, or 3 when a part of a recording is missing.

    Raises:
        ConfigError: Nothing was recorded, or a name, an option, the span or the path is wrong.
    """
    run_paths, signal_names = split_runs_and_signals(arguments)
    _validate_options(run_paths, signal_names, mean=mean, from_one_run=paper or path)
    records = load_armed_runs(run_paths)
    folder = run_paths[0] if run_paths[0].is_dir() else run_paths[0].parent
    style = ["dark_background", FIGURE_STYLE] if dark else FIGURE_STYLE
    with matplotlib.style.context(style):
        if paper:
            _write_paper_figures(records[0], output_path or folder, width_in, span_s)
        else:
            figure_path = output_path or folder / ("path.pdf" if path else "plot.pdf")
            if figure_path.suffix not in FILE_SUFFIXES:
                raise ConfigError(
                    f"--out {figure_path}: give a file that ends in {', '.join(FILE_SUFFIXES)}",
                    code="command/invalid-option",
                )
            if path:
                figure = draw_head_and_tail_paths(records[0], width_in, span_s)
            else:
                figure = draw_signals(
                    _make_groups(records, mean=mean), signal_names, width_in, span_s
                )
            write_figure(figure, figure_path)
    return max(
        report_missing_data(run, record.missing)
        for run, record in zip(run_paths, records, strict=True)
    )


def _validate_options(
    runs: Sequence[Path], names: Sequence[str], *, mean: bool, from_one_run: bool
) -> None:
    """Raise ConfigError for options that do not fit together."""
    if from_one_run and (len(runs) > 1 or names or mean):
        raise ConfigError(
            "--path and --paper draw one run, without signals and --mean; give one run, or leave them out",
            code="command/conflicting-options",
        )
    if mean and len(runs) == 1:
        raise ConfigError(
            "--mean: one run has no mean; give several runs that differ in their seeds",
            code="command/invalid-option",
        )


def _make_groups(records: Sequence[RunRecord], *, mean: bool) -> list[RunGroup]:
    """Return what is drawn as one line each, and print over which time the means are."""
    if not mean:
        return make_single_run_groups(records)
    groups = group_runs_by_configuration(records)
    for group in groups:
        if len(group.records) > 1:
            shortest = min(group.records, key=lambda record: record.time_s[-1] - record.time_s[0])
            print_line(
                f"{group.label}, with its 95 % interval by Student's t; until {group.end_s:.2f} s, the end of "
                f"{shortest.path}"
            )
    return groups


def _write_paper_figures(
    record: RunRecord, folder: Path, width_in: float, span_s: tuple[float, float]
) -> None:
    if folder.suffix in FILE_SUFFIXES:
        raise ConfigError(
            f"--out {folder}: the paper's figures are several files; give a folder",
            code="command/invalid-option",
        )
    for name, figure in draw_paper_figures(record, width_in, span_s).items():
        write_figure(figure, folder / f"{name}.pdf")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file in the format of its suffix, and print the path. Raises ConfigError."""
    content = io.BytesIO()  # matplotlib's PDF writer raises errors of its own after one of the disk
    figure.savefig(content, format=path.suffix[1:])
    with export_atomically(path) as partial:
        partial.write_bytes(content.getvalue())
    print_line(f"written: {path}")

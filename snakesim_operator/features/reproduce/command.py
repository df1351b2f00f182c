"""Lists and runs experiments, and prints and writes what they found."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_operator.base.worker_pool import WorkerPool
from snakesim_operator.features.reproduce.comparison_text import (
    describe_lines,
    list_lines,
    make_entry,
    make_record,
)
from snakesim_operator.features.reproduce.experiment import Experiment, ExperimentFindings
from snakesim_operator.features.reproduce.experiments import EXPERIMENTS
from snakesim_operator.features.reproduce.trials import ExperimentTrials

ALL = "all"


def list_experiments(*, as_json: bool) -> int:
    """Print name, year and source of each experiment. Returns the exit code."""
    if as_json:
        print_json([make_entry(experiment) for experiment in EXPERIMENTS.values()])
        return 0
    for line in list_lines(list(EXPERIMENTS.values())):
        print_line(line)
    return 0


def reproduce(
    names: Sequence[str],
    out: Path | None,
    *,
    seeds: int,
    worker_count: int | None,
    is_quick: bool,
    as_json: bool,
) -> int:
    """Run experiments, and print what they found.

    Args:
        names: Names of experiments, or `all`.
        out: Folder for a picture of each; None: write none.
        seeds: Seeds of experiments whose result depends on it.
        worker_count: Processes that run the simulator; None: one for each core.
        is_quick: Whether to make fewer runs.
        as_json: Whether to print one line of JSON for all.

    Returns:
        The exit code.

    Raises:
        ConfigError: There is no such experiment, or a file cannot be written.
    """
    experiments = select_experiments(names)
    records = []
    for experiment, findings in run_experiments(
        experiments, seeds=seeds, worker_count=worker_count, is_quick=is_quick
    ):
        if as_json:
            records.append(make_record(experiment, findings))
        else:
            for line in (*describe_lines(experiment, findings), ""):
                print_line(line)
        if out is not None:
            path = write_experiment_picture(experiment, findings, out)
            if not as_json:
                print_line(f"picture: {path}")
                print_line("")
    if as_json:
        print_json(records)
    return 0


def run_experiments(
    experiments: Sequence[Experiment],
    *,
    seeds: int,
    worker_count: int | None,
    is_quick: bool = False,
) -> Iterator[tuple[Experiment, ExperimentFindings]]:
    """Run experiments one after the other, and yield what each found."""
    with WorkerPool(worker_count) as pool:
        trials = ExperimentTrials(pool, seeds, is_quick=is_quick)
        for experiment in experiments:
            yield experiment, experiment.run(trials)


def write_experiment_picture(
    experiment: Experiment, findings: ExperimentFindings, folder: Path
) -> Path:
    """Write the picture of an experiment into a folder, and return its path. Raises ConfigError if that fails."""
    from snakesim_operator.features.reproduce.picture import write_picture

    path = folder / f"{experiment.name}.png"
    write_picture(findings.picture, experiment.name, path)
    return path


def select_experiments(names: Sequence[str]) -> list[Experiment]:
    """Return the experiments with these names, each once.

    Raises:
        ConfigError: No name is given, or there is no experiment with a name.
    """
    if not names:
        raise ConfigError(
            f"reproduce: no experiment; give names of {', '.join(EXPERIMENTS)}, or `{ALL}`. "
            "`snakesim reproduce --list` prints their sources",
            code="command/invalid-option",
        )
    if ALL in names:
        return list(EXPERIMENTS.values())
    for name in names:
        if name not in EXPERIMENTS:
            raise ConfigError(
                f"reproduce: no experiment {shorten(name)!r}; {suggest_word(name, list(EXPERIMENTS))}there are "
                f"{', '.join(EXPERIMENTS)}, and `{ALL}`",
                code="command/invalid-option",
            )
    return [EXPERIMENTS[name] for name in dict.fromkeys(names)]

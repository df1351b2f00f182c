"""Runs the search of `snakesim policy train`, and keeps its newest state in a folder."""

import math
import resource
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snakesim.training import kept_search
from snakesim.training.curve import write_curve
from snakesim.training.episodes import EpisodeRunner
from snakesim.training.exported import read_learned_parameters, write_onnx_file
from snakesim.training.form import PolicyArrays
from snakesim.training.search import SearchEffort, SearchGeneration, SearchStep, run_search
from snakesim_hal.base.process import raise_on_stop_signals
from snakesim_hal.base.terminal import print_line
from snakesim_operator.run.conclusion import EXIT_INTERRUPTED

POLICY_FILE = "policy.onnx"


def train_policy(
    arguments: Mapping[str, Any],
    form: str,
    begin: str | None,
    effort: SearchEffort,
    folder: Path,
    *,
    worker_count: int | None,
    cluster: str | None,
    again: Sequence[str],
    resume: bool = False,
) -> int:
    """Run the search for a policy, and write the best policy and the learning curve after each generation.

    Args:
        arguments: Arguments of `SnakeEnv`, by name, among them `frame_skip`.
        form: Name of the form in FORMS whose parameters are learned.
        begin: Shipped policy, or path of a policy file, with whose parameters the search starts. None starts with those
            of the form.
        effort: Numbers of generations, policies and seeds, and the seed of the search.
        folder: Folder to write to.
        worker_count: Number of processes on this computer. None starts one for each processor.
        cluster: Address of a Dask scheduler, whose workers are used instead. None uses this computer.
        again: Command line of the same search.
        resume: If True, continue the search that was stopped in `folder`.

    Returns:
        The exit code: 0, or 130 if the search was stopped by a signal.

    Raises:
        ConfigError: An argument is wrong. Nothing was run.
    """
    start_time_s = time.monotonic()
    start_values = {} if begin is None else read_learned_parameters(begin)
    curve: list[SearchGeneration] = []
    newest: SearchStep | None = None  # of those that are kept
    with raise_on_stop_signals():
        try:
            with (
                EpisodeRunner(arguments, worker_count, cluster) as episodes,
                kept_search.open_search_file(folder, again, resume=resume) as kept,
            ):
                known_count = len(kept.generations)
                if resume:
                    print_line(
                        f"{known_count} of {effort.generations + 1} generations are done already"
                    )
                for step in run_search(episodes, form, effort, start_values, kept.generations):
                    curve.append(step.row)
                    if len(curve) > known_count:
                        print_line(_format_generation(step.row))
                        policy = PolicyArrays.make_from_parameters(
                            step.best, episodes.axes, episodes.sizes
                        )
                        write_onnx_file(
                            folder / POLICY_FILE, policy, step.best, arguments["frame_skip"], again
                        )
                        write_curve(folder, curve)
                        kept.add(step.kept)
                    newest = step
        except KeyboardInterrupt:
            _print_stopped(newest, folder)
            return EXIT_INTERRUPTED
    assert newest is not None, "a search has at least its last check"
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    print_line(
        f"{folder / POLICY_FILE}: reward {newest.best_reward:.2f} with the check seeds; "
        f"{newest.row.episodes} episodes in {time.monotonic() - start_time_s:.0f} s, "
        f"{usage.ru_utime + usage.ru_stime:.0f} s of processor time"
    )
    return 0


def _print_stopped(newest: SearchStep | None, folder: Path) -> None:
    """Print what is kept of a search that was stopped, and how to continue it."""
    if newest is None:
        print_line("stopped before the first generation was done; nothing is kept")
        return
    print_line(
        f"stopped after generation {newest.row.generation}: {folder / POLICY_FILE} is the best policy until then, "
        f"reward {newest.best_reward:.2f} with the check seeds; the same command continues with --resume"
    )


def _format_generation(row: SearchGeneration) -> str:
    """Return a line about a generation for the terminal."""
    line = f"generation {row.generation}: {row.episodes} episodes"
    if not math.isnan(row.mean_reward):  # the last generation is only checked
        line += f", reward {row.mean_reward:.2f}, best {row.best_reward:.2f}"
    if row.check_reward is not None:
        line += f"; checked {row.check_reward:.2f}: {row.check_advance_m:.2f} m, goal {row.check_goals:.0%}"
    return line

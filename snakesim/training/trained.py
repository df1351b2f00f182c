"""Runs the search of `snakesim policy train`, and keeps its newest state in a folder."""

import math
import resource
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snakesim.training import kept_search
from snakesim.training.curve import write_curve
from snakesim.training.episodes import Episodes
from snakesim.training.exported import export, learned_by
from snakesim.training.form import Policy
from snakesim.training.search import Effort, Generation, Step, search
from snakesim_hal.base.process import stop_signals_raise
from snakesim_hal.base.terminal import print_line
from snakesim_operator.run.conclusion import INTERRUPTED

FRAME_SKIP = 5  # ticks: at 100 Hz, 20 decisions a second
POLICY = "policy.onnx"


def train(
    arguments: Mapping[str, Any],
    form: str,
    begin: str | None,
    effort: Effort,
    out: Path,
    *,
    workers: int | None,
    cluster: str | None,
    again: Sequence[str],
    resume: bool = False,
) -> int:
    """Search, and write the best policy and the learning curve after each generation.

    Args:
        arguments: of `SnakeEnv`.
        form: what is learned.
        begin: a policy, shipped or a file, with whose numbers the search begins.
        effort: how long to search.
        out: the folder to write to.
        workers: how many processes on this computer; None: one a core.
        cluster: address of a Dask scheduler, instead.
        again: the command that does the same.
        resume: go on with the search that was stopped in `out`.

    Returns: 0; 130 when it was stopped.

    Raises:
        ConfigError: wrong input; nothing was run.
    """
    began_s = time.monotonic()
    start = {} if begin is None else learned_by(begin)
    curve: list[Generation] = []
    newest: Step | None = None  # of those that are kept
    with stop_signals_raise():
        try:
            with (
                Episodes({**arguments, "frame_skip": FRAME_SKIP}, workers, cluster) as episodes,
                kept_search.opened(out, again, resume=resume) as kept,
            ):
                known = len(kept.generations)
                if resume:
                    print_line(f"{known} of {effort.generations + 1} generations are done already")
                for step in search(episodes, form, effort, start, kept.generations):
                    curve.append(step.row)
                    if len(curve) > known:
                        print_line(_describe(step.row))
                        policy = Policy.of(step.best, episodes.axes, episodes.sizes)
                        export(out / POLICY, policy, step.best, FRAME_SKIP, again)
                        write_curve(out, curve)
                        kept.add(step.kept)
                    newest = step
        except KeyboardInterrupt:
            _say_stopped(newest, out)
            return INTERRUPTED
    assert newest is not None, "a search has at least its last check"
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print_line(
        f"{out / POLICY}: reward {newest.best_reward:.2f} on fields that it was checked on; {newest.row.episodes} "
        f"episodes in {time.monotonic() - began_s:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of processor time"
    )
    return 0


def _say_stopped(newest: Step | None, out: Path) -> None:
    if newest is None:
        print_line("stopped before the first generation was done; nothing is kept")
        return
    print_line(
        f"stopped after generation {newest.row.generation}: {out / POLICY} is the best policy until then, reward "
        f"{newest.best_reward:.2f} on fields that it was checked on; the same command goes on with --resume"
    )


def _describe(row: Generation) -> str:
    """Return a line about a generation for the terminal."""
    line = f"generation {row.generation}: {row.episodes} episodes"
    if not math.isnan(row.mean_reward):  # the last generation is only checked
        line += f", reward {row.mean_reward:.2f}, best {row.best_reward:.2f}"
    if row.check_reward is not None:
        line += f"; checked {row.check_reward:.2f}: {row.check_advance_m:.2f} m, goal {row.check_goals:.0%}"
    return line

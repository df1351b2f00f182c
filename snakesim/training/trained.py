"""`snakesim train`: search, and keep the newest state of it in a folder."""

import resource
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snakesim.training.curve import write_curve
from snakesim.training.episodes import Episodes
from snakesim.training.exported import export, learned_by
from snakesim.training.form import Policy
from snakesim.training.search import Effort, Generation, search
from snakesim_hal.terminal import say

FRAME_SKIP = 5  # ticks: at 100 Hz, 20 decisions a second


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
) -> int:
    """Exit code. Raises ConfigError for wrong input.

    arguments: of `SnakeEnv`. begin: a policy, shipped or a file, with whose numbers it begins. again: the command that
    does the same.
    """
    began_s = time.monotonic()
    curve: list[Generation] = []
    start = {} if begin is None else learned_by(begin)

    def tell(row: Generation, best: Mapping[str, float]) -> None:
        curve.append(row)
        say(_line(row))
        policy = Policy.of(best, episodes.axes, episodes.sizes)
        export(out / "policy.onnx", policy, best, FRAME_SKIP, again)
        write_curve(out, curve)

    with Episodes({**arguments, "frame_skip": FRAME_SKIP}, workers, cluster) as episodes:
        out.mkdir(parents=True, exist_ok=True)
        _, reward = search(episodes, form, effort, start, tell)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    say(
        f"{out / 'policy.onnx'}: reward {reward:.2f} on fields that it was checked on; {curve[-1].episodes} "
        f"episodes in {time.monotonic() - began_s:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of processor time"
    )
    return 0


def _line(row: Generation) -> str:
    line = f"generation {row.generation}: {row.episodes} episodes"
    if row.mean_reward == row.mean_reward:  # none in the last one, which is a check alone
        line += f", reward {row.mean_reward:.2f}, best {row.best_reward:.2f}"
    if row.check_reward is not None:
        line += f"; checked {row.check_reward:.2f}: {row.check_advance_m:.2f} m, goal {row.check_goals:.0%}"
    return line

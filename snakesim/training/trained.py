"""`snakesim train`: search, and keep the newest state of it in a folder."""

import resource
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snakesim.training.curve import write_curve
from snakesim.training.episodes import Episodes
from snakesim.training.exported import export, learned_by
from snakesim.training.form import Policy
from snakesim.training.search import Effort, Generation, search
from snakesim_hal.terminal import say

FRAME_SKIP = 5  # ticks: at 100 Hz, 20 decisions a second


@dataclass(frozen=True)
class Request:
    """What the command was given."""

    scenario: str
    duration_s: float | None
    reward: Mapping[str, Any]
    set: Mapping[str, Any]
    draw: Mapping[str, Sequence[Any]]  # keys of a number that each field has of its own: lowest, highest
    form: str
    begin: str | None  # a policy, shipped or a file, with whose numbers it begins
    effort: Effort
    workers: int | None
    cluster: str | None
    out: Path
    again: Sequence[str]  # the command that does the same


def train(request: Request) -> int:
    """Exit code. Raises ConfigError for wrong input."""
    began_s = time.monotonic()
    arguments = {
        "scenario": request.scenario,
        "duration": request.duration_s,
        "reward": dict(request.reward),
        "set": dict(request.set),
        "draw": dict(request.draw),
        "frame_skip": FRAME_SKIP,
    }
    curve: list[Generation] = []
    begin = {} if request.begin is None else learned_by(request.begin)

    def tell(row: Generation, best: Mapping[str, float]) -> None:
        curve.append(row)
        say(_line(row))
        policy = Policy.of(best, episodes.axes, episodes.sizes)
        export(request.out / "policy.onnx", policy, best, FRAME_SKIP, request.again)
        write_curve(request.out, curve)

    with Episodes(arguments, request.workers, request.cluster) as episodes:
        request.out.mkdir(parents=True, exist_ok=True)
        _, reward = search(episodes, request.form, request.effort, begin, tell)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    say(
        f"{request.out / 'policy.onnx'}: reward {reward:.2f} on fields that it was checked on; {curve[-1].episodes} "
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

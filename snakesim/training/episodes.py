"""Episodes of policies, in a process for each processor."""

import os
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Self

import numpy as np

from snakesim.environments import SnakeEnv
from snakesim.training.form import OBSERVE, Policy
from snakesim_hal.errors import ConfigError
from snakesim_hal.process import die_with_parent

Values = Mapping[str, float]
_SEATS: list[SnakeEnv] = []  # of this process: one environment


@dataclass(frozen=True)
class Episode:
    """What came of one. Energy: sum over joints of |torque x velocity| over time."""

    paid: float
    advance_m: float
    energy_j: float
    time_s: float
    goal: bool


class Episodes:
    """Runs them. The same policies and fields give the same numbers, with any number of processes."""

    def __init__(self, arguments: Mapping[str, Any], workers: int | None = None) -> None:
        """arguments: of `SnakeEnv`. Raises ConfigError for wrong ones."""
        _seat(arguments)
        env = _SEATS[-1]
        self.axes = [joint.axis for joint in env.description.joints]
        self.sizes = {name: len(part.names) for name, part in env.parts.items()}
        count = workers or len(os.sched_getaffinity(0))
        self._pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_begin, initargs=(dict(arguments),))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=True)

    def run(self, policies: Sequence[Values], fields: Sequence[int]) -> list[list[Episode]]:
        """Every policy on every field; those that a scene cannot have are left out."""
        made = [Policy.of(values, self.axes, self.sizes) for values in policies]
        jobs = [(policy, field) for policy in made for field in fields]
        found = list(self._pool.map(_episode, *zip(*jobs, strict=True)))
        return [
            [episode for episode in found[start : start + len(fields)] if episode is not None]
            for start in range(0, len(found), len(fields))
        ]


def _begin(arguments: Mapping[str, Any]) -> None:
    """In each process."""
    die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the command
    _seat(arguments)


def _seat(arguments: Mapping[str, Any]) -> None:
    _SEATS[:] = [SnakeEnv(**{**arguments, "observe": OBSERVE, "action": "position"})]


def _episode(policy: Policy, field: int) -> Episode | None:
    env = _SEATS[-1]
    try:
        seen, info = env.reset(seed=field)
    except ConfigError:  # obstacles that find no place
        return None
    paid = energy = 0.0
    over = False
    while not over:
        seen, reward, terminated, truncated, info = env.step(policy.targets(np.asarray(seen)))
        paid, energy = paid + reward, energy + info["energy_j"]
        over = terminated or truncated
    env.close()
    return Episode(paid, info["advance_m"], energy, info["time_s"], info["ended"] == "goal")

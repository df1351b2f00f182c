"""Episodes of policies, in a process for each processor, or on the workers of a Dask cluster."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from snakesim.environments import SnakeEnv
from snakesim.training.form import OBSERVE, Policy
from snakesim_hal.base.errors import ConfigError
from snakesim_operator.base.worker_pool import WorkerPool

RETRIES = 2  # of an episode whose worker died
Values = Mapping[str, float]
Arguments = Mapping[str, Any]  # of `SnakeEnv`
Map = Callable[[Callable[..., Any], Sequence[Sequence[Any]]], list[Any]]  # what each call returns, in their order
_SEATS: list[tuple[Arguments, SnakeEnv]] = []  # of this process: one environment


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

    def __init__(self, arguments: Arguments, workers: int | None = None, cluster: str | None = None) -> None:
        """cluster: address of a Dask scheduler. Raises ConfigError, NotConnectedError."""
        self._arguments = dict(arguments)
        self._workers = workers
        self._cluster = cluster
        self._opened = ExitStack()
        env = _seat(self._arguments)
        self.axes = [joint.axis for joint in env.description.joints]
        self.sizes = {name: len(part.names) for name, part in env.parts.items()}

    def __enter__(self) -> Self:
        self._map = self._map_here() if self._cluster is None else self._map_there(self._cluster)
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def run(self, policies: Sequence[Values], fields: Sequence[int]) -> list[list[Episode]]:
        """Every policy on every field; those that a scene cannot have are left out."""
        made = [Policy.of(values, self.axes, self.sizes) for values in policies]
        jobs = [(self._arguments, policy, field) for policy in made for field in fields]
        found = self._map(_episode, jobs)
        return [
            [episode for episode in found[start : start + len(fields)] if episode is not None]
            for start in range(0, len(found), len(fields))
        ]

    def _map_here(self) -> Map:
        return self._opened.enter_context(WorkerPool(self._workers)).map

    def _map_there(self, address: str) -> Map:
        from snakesim_operator.base.dask_cluster import connected  # of another extra

        client = self._opened.enter_context(connected(address))
        executor = client.get_executor(pure=False, retries=RETRIES)
        return lambda function, calls: list(executor.map(function, *zip(*calls, strict=True)))


def _seat(arguments: Arguments) -> SnakeEnv:
    """The environment of this process; another one for other arguments."""
    if not _SEATS or _SEATS[-1][0] != arguments:
        _SEATS[:] = [(arguments, SnakeEnv(**{**arguments, "observe": OBSERVE, "action": "position"}))]
    return _SEATS[-1][1]


def _episode(arguments: Arguments, policy: Policy, field: int) -> Episode | None:
    env = _seat(arguments)
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

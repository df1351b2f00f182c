"""Runs episodes of policies, in a process for each processor or on the workers of a Dask cluster."""

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
Values = Mapping[str, float]  # parameters of a policy, by name
Arguments = Mapping[str, Any]  # of `SnakeEnv`
Map = Callable[[Callable[..., Any], Sequence[Sequence[Any]]], list[Any]]
"""Calls a function with each of several argument lists, and returns the results in their order."""
_CACHED_ENVS: list[tuple[Arguments, SnakeEnv]] = []  # the environment of this process, at most one


@dataclass(frozen=True)
class Episode:
    """The result of one episode."""

    paid: float  # sum of rewards
    advance_m: float
    energy_j: float  # sum over joints of |torque x velocity| over time
    time_s: float
    goal: bool  # whether the goal was reached


class Episodes:
    """Runs episodes, within a `with` block.

    The same policies and fields give the same numbers with any number of processes.
    """

    def __init__(self, arguments: Arguments, workers: int | None = None, cluster: str | None = None) -> None:
        """Load the scenario in this process; `with` starts the workers.

        Args:
            arguments: Arguments of `SnakeEnv`.
            workers: Number of processes on this computer; None starts one for each processor.
            cluster: Address of a Dask scheduler, whose workers are used instead.

        Raises:
            ConfigError: An argument of `SnakeEnv` is wrong.
        """
        self._arguments = dict(arguments)
        self._workers = workers
        self._cluster = cluster
        self._opened = ExitStack()
        env = _cached_env(self._arguments)
        self.axes = [joint.axis for joint in env.description.joints]
        self.sizes = {name: len(part.names) for name, part in env.parts.items()}

    def __enter__(self) -> Self:
        if self._cluster is None:
            self._map = self._start_workers()
        else:
            self._map = self._connect_to_cluster(self._cluster)
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def run(self, policies: Sequence[Values], fields: Sequence[int]) -> list[list[Episode]]:
        """Run every policy on every field.

        Args:
            policies: Parameters of each policy.
            fields: Seeds of the random fields.

        Returns:
            The episodes of each policy. Fields without room for their obstacles are left out.
        """
        jobs: list[tuple[Arguments, Policy, int]] = []
        for values in policies:
            policy = Policy.of(values, self.axes, self.sizes)
            jobs += [(self._arguments, policy, field) for field in fields]
        results = self._map(_run_episode, jobs)
        episodes: list[list[Episode]] = []
        for start in range(0, len(results), len(fields)):
            of_policy = results[start : start + len(fields)]
            episodes.append([episode for episode in of_policy if episode is not None])
        return episodes

    def _start_workers(self) -> Map:
        return self._opened.enter_context(WorkerPool(self._workers)).map

    def _connect_to_cluster(self, address: str) -> Map:
        """Connect to a Dask scheduler. Raises ConfigError, NotConnectedError."""
        from snakesim_operator.base.dask_cluster import connected  # Dask is of another extra

        client = self._opened.enter_context(connected(address))
        executor = client.get_executor(pure=False, retries=RETRIES)
        return lambda function, calls: list(executor.map(function, *zip(*calls, strict=True)))


def _cached_env(arguments: Arguments) -> SnakeEnv:
    """Return the environment of this process. It is made anew when the arguments change."""
    if not _CACHED_ENVS or _CACHED_ENVS[-1][0] != arguments:
        env = SnakeEnv(**{**arguments, "observe": OBSERVE, "action": "position"})
        _CACHED_ENVS[:] = [(arguments, env)]
    return _CACHED_ENVS[-1][1]


def _run_episode(arguments: Arguments, policy: Policy, field: int) -> Episode | None:
    """Run one episode in a worker. None: the obstacles of this field find no place."""
    env = _cached_env(arguments)
    try:
        observation, info = env.reset(seed=field)
    except ConfigError:
        return None
    paid = 0.0
    energy_j = 0.0
    over = False
    while not over:
        target_rad = policy.targets(np.asarray(observation))
        observation, reward, terminated, truncated, info = env.step(target_rad)
        paid += reward
        energy_j += info["energy_j"]
        over = terminated or truncated
    env.close()
    return Episode(paid, info["advance_m"], energy_j, info["time_s"], info["ended"] == "goal")

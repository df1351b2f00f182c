"""Runs episodes of policies, in a process for each processor or on the workers of a Dask cluster.

Every process steps its share of the episodes together, in environments that are rows of arrays.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from snakesim.environments import SnakeEnv
from snakesim.environments.episodes import Episodes as Environments
from snakesim.environments.setup import EnvironmentSetup
from snakesim.training.form import OBSERVE, Policy
from snakesim_hal.base.errors import ConfigError
from snakesim_operator.base.worker_pool import WorkerPool

RETRIES = 2  # of an episode whose worker died
Values = Mapping[str, float]  # parameters of a policy, by name
Arguments = Mapping[str, Any]  # of `SnakeEnv`
Map = Callable[[Callable[..., Any], Sequence[Sequence[Any]]], list[Any]]
"""Calls a function with each of several argument lists, and returns the results in their order."""
Job = tuple[Policy, int]  # an episode: what acts, and the seed of its field
MAX_TOGETHER = 32  # episodes that a process steps together; a worker that dies loses no more


@dataclass(frozen=True)
class _Cached:
    """The environments of this process."""

    arguments: Arguments
    setup: EnvironmentSetup
    environments: Environments


_CACHED: list[_Cached] = []  # at most one


@dataclass(frozen=True)
class Episode:
    """The result of one episode."""

    total_reward: float  # sum of rewards
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
        self._shares = 1  # into which the episodes are divided: one for each worker
        setup = _make_setup(self._arguments)
        self.axes = [joint.axis for joint in setup.description.joints]
        self.sizes = {name: len(part.names) for name, part in setup.parts.items()}

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
        jobs: list[Job] = []
        for values in policies:
            policy = Policy.of(values, self.axes, self.sizes)
            jobs += [(policy, field) for field in fields]
        size = min(max(math.ceil(len(jobs) / self._shares), 1), MAX_TOGETHER)
        groups = [jobs[start : start + size] for start in range(0, len(jobs), size)]
        results = self._map(_run_together, [(self._arguments, group) for group in groups])
        ran = [episode for of_group in results for episode in of_group]
        episodes: list[list[Episode]] = []
        for start in range(0, len(ran), len(fields)):
            of_policy = ran[start : start + len(fields)]
            episodes.append([episode for episode in of_policy if episode is not None])
        return episodes

    def _start_workers(self) -> Map:
        pool = self._opened.enter_context(WorkerPool(self._workers))
        self._shares = pool.size
        return pool.map

    def _connect_to_cluster(self, address: str) -> Map:
        """Connect to a Dask scheduler. Raises ConfigError, NotConnectedError."""
        from snakesim_operator.base.dask_cluster import connected  # Dask is of another extra

        client = self._opened.enter_context(connected(address))
        threads: Any = client.nthreads()  # of each worker
        self._shares = max(sum(threads.values()), 1)
        executor = client.get_executor(pure=False, retries=RETRIES)
        return lambda function, calls: list(executor.map(function, *zip(*calls, strict=True)))


def _make_setup(arguments: Arguments) -> EnvironmentSetup:
    """Return what environments with these arguments share."""
    return SnakeEnv(**{**arguments, "observe": OBSERVE, "action": "position"}).setup


def _find_environments(arguments: Arguments) -> tuple[EnvironmentSetup, Environments]:
    """Return the environments of this process, MAX_TOGETHER. They are made anew when the arguments change."""
    if not _CACHED or _CACHED[-1].arguments != arguments:
        setup = _make_setup(arguments)
        _CACHED[:] = [_Cached(arguments, setup, Environments(setup, MAX_TOGETHER, threads=1))]
    return _CACHED[-1].setup, _CACHED[-1].environments


def _run_together(arguments: Arguments, jobs: Sequence[Job]) -> list[Episode | None]:
    """Run episodes in a worker, all at once.

    Args:
        arguments: Arguments of `SnakeEnv`.
        jobs: Policy and seed of the field of each episode, at most MAX_TOGETHER.

    Returns:
        An episode for each job; None if the obstacles of its field find no place.
    """
    setup, environments = _find_environments(arguments)
    count = MAX_TOGETHER
    can_run = np.zeros(count, dtype=np.bool_)
    for row, (_, field) in enumerate(jobs):
        can_run[row] = _reset(environments, row, field)
    observations = environments.observe(can_run)
    targets_rad = np.zeros((count, len(setup.action_names)))
    total_reward = np.zeros(count)
    energy_j = np.zeros(count)
    endings: dict[int, str] = {}
    while True:
        is_active = can_run & ~environments.is_over
        rows = np.flatnonzero(is_active).tolist()
        if not rows:
            break
        targets_rad = targets_rad.copy()
        for row in rows:
            targets_rad[row] = jobs[row][0].targets(observations[row])
        result = environments.step(targets_rad, is_active)
        observations = result.observations
        total_reward = total_reward + np.where(is_active, result.rewards, 0.0)
        energy_j = energy_j + np.where(is_active, result.energy_j, 0.0)
        endings |= result.endings
    advance_m = environments.advance_m.tolist()
    time_s = environments.time_s.tolist()
    episodes: list[Episode | None] = []
    for row in range(len(jobs)):
        if not can_run[row]:
            episodes.append(None)
            continue
        goal = endings[row] == "goal"
        episodes.append(Episode(float(total_reward[row]), advance_m[row], float(energy_j[row]), time_s[row], goal))
    for row in range(count):
        environments.close(row)
    return episodes


def _reset(environments: Environments, row: int, field: int) -> bool:
    """Start an episode on a field. Returns False if its obstacles find no place."""
    try:
        environments.reset(row, field, np.random.default_rng(field))
    except ConfigError:
        return False
    return True

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
from snakesim.environments.episodes import EpisodeBatch as Environments
from snakesim.environments.setup import EnvironmentSetup
from snakesim.training.form import OBSERVE, PolicyArrays
from snakesim_hal.base.errors import ConfigError
from snakesim_operator.base.worker_pool import WorkerPool

WORKER_RETRIES = 2  # of an episode whose worker died
Values = Mapping[str, float]  # parameters of a policy, by name
Arguments = Mapping[str, Any]  # of `SnakeEnv`
MapFunction = Callable[[Callable[..., Any], Sequence[Sequence[Any]]], list[Any]]
"""Calls a function with each of several argument lists, and returns the results in their order."""
Job = tuple[PolicyArrays, int]  # an episode: what acts, and its seed
MAX_BATCH_SIZE = 32  # episodes that a process steps together; a worker that dies loses no more


@dataclass(frozen=True)
class _CachedEnvironments:
    """The environments of this process."""

    arguments: Arguments
    setup: EnvironmentSetup
    environments: Environments


_ENVIRONMENT_CACHE: list[_CachedEnvironments] = []  # at most one


@dataclass(frozen=True)
class EpisodeResult:
    """The result of one episode."""

    total_reward: float  # sum of rewards
    advance_m: float
    energy_j: float  # sum over joints of |torque x velocity| over time
    time_s: float
    goal: bool  # whether the goal was reached


class EpisodeRunner:
    """Runs episodes, within a `with` block.

    The same policies and seeds give the same numbers with any number of processes.
    """

    def __init__(
        self, arguments: Arguments, worker_count: int | None = None, cluster: str | None = None
    ) -> None:
        """Load the scenario in this process. The `with` block starts the workers.

        Args:
            arguments: Arguments of `SnakeEnv`, by name.
            worker_count: Number of processes on this computer. None starts one for each processor.
            cluster: Address of a Dask scheduler, whose workers run the episodes instead. None uses this computer.

        Raises:
            ConfigError: An argument of `SnakeEnv` is wrong.
        """
        self._arguments = dict(arguments)
        self._workers = worker_count
        self._cluster = cluster
        self._exit_stack = ExitStack()
        self._batch_count = 1  # into how many batches the episodes are divided: one for each worker
        setup = _make_setup(self._arguments)
        self.axes = [joint.axis for joint in setup.description.joints]
        self.sizes = {name: len(part.names) for name, part in setup.parts.items()}

    def __enter__(self) -> Self:
        if self._cluster is None:
            self._map_jobs = self._start_workers()
        else:
            self._map_jobs = self._connect_to_cluster(self._cluster)
        return self

    def __exit__(self, *_: object) -> None:
        self._exit_stack.close()

    def run(self, policies: Sequence[Values], seeds: Sequence[int]) -> list[list[EpisodeResult]]:
        """Run every policy with every seed.

        Args:
            policies: Parameters of each policy, by name.
            seeds: Seeds of the episodes, and so of their random scenes.

        Returns:
            A list of episodes for each policy. Seeds whose scene has no room for its obstacles are left out.
        """
        jobs: list[Job] = []
        for values in policies:
            policy = PolicyArrays.make_from_parameters(values, self.axes, self.sizes)
            jobs += [(policy, seed) for seed in seeds]
        batch_size = min(max(math.ceil(len(jobs) / self._batch_count), 1), MAX_BATCH_SIZE)
        batches = [jobs[start : start + batch_size] for start in range(0, len(jobs), batch_size)]
        results = self._map_jobs(_run_batch, [(self._arguments, batch) for batch in batches])
        all_episodes = [episode for batch_episodes in results for episode in batch_episodes]
        episodes_by_policy: list[list[EpisodeResult]] = []
        for start in range(0, len(all_episodes), len(seeds)):
            policy_episodes = all_episodes[start : start + len(seeds)]
            episodes_by_policy.append(
                [episode for episode in policy_episodes if episode is not None]
            )
        return episodes_by_policy

    def _start_workers(self) -> MapFunction:
        """Start the worker processes on this computer."""
        pool = self._exit_stack.enter_context(WorkerPool(self._workers))
        self._batch_count = pool.size
        return pool.run_and_collect

    def _connect_to_cluster(self, address: str) -> MapFunction:
        """Connect to a Dask scheduler. Raises ConfigError, NotConnectedError."""
        # Dask is of another extra.
        from snakesim_operator.base.dask_cluster import connect_to_cluster

        client = self._exit_stack.enter_context(connect_to_cluster(address))
        threads: Any = client.nthreads()  # of each worker
        self._batch_count = max(sum(threads.values()), 1)
        executor = client.get_executor(pure=False, retries=WORKER_RETRIES)
        return lambda function, calls: list(executor.map(function, *zip(*calls, strict=True)))


def _make_setup(arguments: Arguments) -> EnvironmentSetup:
    """Return what environments with these arguments share."""
    return SnakeEnv(**{**arguments, "observe": OBSERVE, "action": "position"}).setup


def _get_cached_environments(arguments: Arguments) -> tuple[EnvironmentSetup, Environments]:
    """Return the environments of this process, MAX_BATCH_SIZE. They are made anew when the arguments change."""
    if not _ENVIRONMENT_CACHE or _ENVIRONMENT_CACHE[-1].arguments != arguments:
        setup = _make_setup(arguments)
        _ENVIRONMENT_CACHE[:] = [
            _CachedEnvironments(
                arguments, setup, Environments(setup, MAX_BATCH_SIZE, thread_count=1)
            )
        ]
    return _ENVIRONMENT_CACHE[-1].setup, _ENVIRONMENT_CACHE[-1].environments


def _run_batch(arguments: Arguments, jobs: Sequence[Job]) -> list[EpisodeResult | None]:
    """Run a batch of episodes in this process, stepped together.

    Args:
        arguments: Arguments of `SnakeEnv`, by name.
        jobs: Policy and seed of each episode. At most MAX_BATCH_SIZE.

    Returns:
        An episode for each job, in order. It is None if the scene has no room for its obstacles.
    """
    setup, environments = _get_cached_environments(arguments)
    row_count = MAX_BATCH_SIZE  # rows behind those of the jobs stay empty
    can_run = np.zeros(row_count, dtype=np.bool_)
    for row, (_, seed) in enumerate(jobs):
        can_run[row] = _start_episode(environments, row, seed)
    observations = environments.observe(can_run)
    targets_rad = np.zeros((row_count, len(setup.action_names)))
    total_reward = np.zeros(row_count)
    energy_j = np.zeros(row_count)
    ending_by_row: dict[int, str] = {}
    while True:
        is_active = can_run & ~environments.is_over
        rows = np.flatnonzero(is_active).tolist()
        if not rows:
            break
        targets_rad = targets_rad.copy()
        for row in rows:
            targets_rad[row] = jobs[row][0].compute_targets(observations[row])
        result = environments.step(targets_rad, is_active)
        observations = result.observations
        total_reward = total_reward + np.where(is_active, result.rewards, 0.0)
        energy_j = energy_j + np.where(is_active, result.energy_j, 0.0)
        ending_by_row |= result.endings
    advance_m = environments.advance_m.tolist()
    time_s = environments.time_s.tolist()
    episodes: list[EpisodeResult | None] = []
    for row in range(len(jobs)):
        if not can_run[row]:
            episodes.append(None)
            continue
        is_goal_reached = ending_by_row[row] == "goal"
        episodes.append(
            EpisodeResult(
                float(total_reward[row]),
                advance_m[row],
                float(energy_j[row]),
                time_s[row],
                is_goal_reached,
            )
        )
    for row in range(row_count):
        environments.close(row)
    return episodes


def _start_episode(environments: Environments, row: int, seed: int) -> bool:
    """Start an episode with a seed. Return False if its scene has no room for its obstacles."""
    try:
        environments.reset(row, seed, np.random.default_rng(seed))
    except ConfigError:
        return False
    return True

"""Runs trials on workers: processes on this computer, or those of a Dask cluster."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from snakesim_operator.base.worker_pool import (
    MAX_WORKER_DEATHS,
    CallFailure,
    CallTookTooLongError,
    WorkerDiedError,
    WorkerPool,
)
from snakesim_operator.base.worker_pool import Outcome as CallOutcome
from snakesim_operator.features.evaluate.trial import (
    EvaluationTrial,
    TrialOutcome,
    compute_code_digest,
    make_timeout_outcome,
    run_trial,
)

if TYPE_CHECKING:  # Dask takes a second to import, and only `--cluster` needs it
    from distributed import Client, Future

MAX_RETRIES = 2  # of a trial that raised an exception in a worker of a cluster
# Added to the timeout of a trial, which only Python code obeys, because workers take time to start.
KILL_GRACE_PERIOD_S = 30.0


class TrialWorkers(Protocol):
    """Runs trials, several at a time."""

    def count_workers(self) -> int:
        """Return how many workers there are now, that is how many trials run at a time."""
        ...

    def run_trials(
        self, trials: Sequence[EvaluationTrial]
    ) -> Iterator[tuple[EvaluationTrial, TrialOutcome]]:
        """Run all trials, and yield each with its outcome as soon as it is done.

        Args:
            trials: Trials with different ids, in the order in which they are started.
        """
        ...


@contextmanager
def start_workers(cluster: str | None, process_count: int | None = None) -> Iterator[TrialWorkers]:
    """Provide processes that run trials: those of a Dask cluster, or new ones here that end with the context.

    Args:
        cluster: Address of a Dask scheduler; None for processes on this computer, to which nothing can connect.
        process_count: Number of processes on this computer; None for one process for each core.

    Raises:
        ConfigError: The address is invalid.
        NotConnectedError: The scheduler does not answer.
    """
    if cluster is None:
        with WorkerPool(process_count) as pool:
            yield LocalWorkers(pool)
    else:
        from snakesim_operator.base.dask_cluster import connect_to_cluster

        with connect_to_cluster(cluster) as client:
            yield ClusterWorkers(client)


class LocalWorkers:
    """Processes on this computer."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool

    def count_workers(self) -> int:
        return self._pool.size

    def run_trials(
        self, trials: Sequence[EvaluationTrial]
    ) -> Iterator[tuple[EvaluationTrial, TrialOutcome]]:
        if not trials:
            return
        calls = [_make_call_arguments(trial) for trial in trials]
        limit_s = max(trial.wall_timeout_s for trial in trials) + KILL_GRACE_PERIOD_S
        for number, outcome in self._pool.run_calls(run_trial, calls, limit_s):
            trial = trials[number]
            yield trial, _make_outcome_of_call(trial, outcome)


class ClusterWorkers:
    """The workers of a Dask cluster."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    def count_workers(self) -> int:
        return max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)

    def run_trials(
        self, trials: Sequence[EvaluationTrial]
    ) -> Iterator[tuple[EvaluationTrial, TrialOutcome]]:
        from distributed import as_completed

        submitted: dict[Future, EvaluationTrial] = {}
        for index, trial in enumerate(trials):
            future = self._client.submit(
                run_trial,
                *_make_call_arguments(trial),
                key=trial.id,
                retries=MAX_RETRIES,
                priority=-index,  # otherwise the last trial begins first
            )
            submitted[future] = trial
        for future in as_completed(submitted, loop=self._client.loop):
            yield submitted[future], _make_outcome_of_future(future)
            future.release()


def _make_call_arguments(trial: EvaluationTrial) -> tuple[bytes, str, float, float]:
    return trial.config, compute_code_digest(), trial.stall_timeout_s, trial.wall_timeout_s


def _make_outcome_of_call(trial: EvaluationTrial, outcome: CallOutcome) -> TrialOutcome:
    if not isinstance(outcome, CallFailure):
        return outcome.value
    match outcome.error:
        case WorkerDiedError():
            return _make_worker_death_outcome(MAX_WORKER_DEATHS)
        case CallTookTooLongError():
            return make_timeout_outcome(trial.wall_timeout_s)
        case error:  # a controller may raise anything; the other trials continue
            return _make_error_outcome(error)


def _make_outcome_of_future(future: "Future") -> TrialOutcome:
    from distributed.scheduler import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        return _make_worker_death_outcome(error.allowed_failures + 1)
    except Exception as error:  # noqa: BLE001 - a controller may raise anything; the other trials continue
        return _make_error_outcome(error)


def _make_worker_death_outcome(count: int) -> TrialOutcome:
    return TrialOutcome(error=f"its worker process died, {count} times; its memory may not suffice")


def _make_error_outcome(error: Exception) -> TrialOutcome:
    return TrialOutcome(error=f"{type(error).__name__}: {error}"[:300])

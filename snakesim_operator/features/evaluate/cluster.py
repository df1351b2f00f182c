"""Runs cases on workers: processes on this computer, or those of a lab's Dask cluster."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from snakesim_operator.base.worker_pool import MAX_DEATHS, CallTookTooLongError, Raised, WorkerDiedError, WorkerPool
from snakesim_operator.base.worker_pool import Outcome as CallOutcome
from snakesim_operator.features.evaluate.case import Case, CaseOutcome, code_digest, run_case, took_too_long

if TYPE_CHECKING:  # Dask takes a second to import, and only `--cluster` needs it
    from distributed import Client, Future

RETRIES = 2  # of a case that raised in a worker of a cluster
KILL_AFTER_S = 30.0  # beyond a case's own limit, which only Python code obeys; a worker takes some seconds to start


class Workers(Protocol):
    """Runs cases, several at a time."""

    def size(self) -> int:
        """Return how many cases run at a time now."""
        ...

    def solve(self, cases: Sequence[Case]) -> Iterator[tuple[Case, CaseOutcome]]:
        """Run all cases; yield each with its outcome as it is done.

        They begin in this order. No two may have one id.
        """
        ...


@contextmanager
def workers(cluster: str | None, count: int | None = None) -> Iterator[Workers]:
    """Provide processes that run cases: those of a Dask cluster, or new ones here that end with the context.

    Args:
        cluster: address of a Dask scheduler; None: processes on this computer, to which nothing can connect.
        count: number of processes on this computer; None: one for each core.

    Raises:
        ConfigError: the address is invalid.
        NotConnectedError: the scheduler does not answer.
    """
    if cluster is None:
        with WorkerPool(count) as pool:
            yield LocalWorkers(pool)
    else:
        from snakesim_operator.base.dask_cluster import connected

        with connected(cluster) as client:
            yield ClusterWorkers(client)


class LocalWorkers:
    """Processes on this computer."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool

    def size(self) -> int:
        return self._pool.size

    def solve(self, cases: Sequence[Case]) -> Iterator[tuple[Case, CaseOutcome]]:
        if not cases:
            return
        calls = [_call_arguments(case) for case in cases]
        limit_s = max(case.limit_s for case in cases) + KILL_AFTER_S
        for number, outcome in self._pool.run(run_case, calls, limit_s):
            yield cases[number], _outcome_of_call(cases[number], outcome)


class ClusterWorkers:
    """The workers of a Dask cluster."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    def size(self) -> int:
        return max(len(self._client.scheduler_info(n_workers=-1)["workers"]), 1)

    def solve(self, cases: Sequence[Case]) -> Iterator[tuple[Case, CaseOutcome]]:
        from distributed import as_completed

        submitted: dict[Future, Case] = {}
        for index, case in enumerate(cases):
            future = self._client.submit(
                run_case,
                *_call_arguments(case),
                key=case.id,
                retries=RETRIES,
                priority=-index,  # otherwise the last case begins first
            )
            submitted[future] = case
        for future in as_completed(submitted, loop=self._client.loop):
            yield submitted[future], _outcome_of_future(future)
            future.release()


def _call_arguments(case: Case) -> tuple[bytes, str, float, float]:
    return case.config, code_digest(), case.give_up_s, case.limit_s


def _outcome_of_call(case: Case, outcome: CallOutcome) -> CaseOutcome:
    if not isinstance(outcome, Raised):
        return outcome.value
    match outcome.error:
        case WorkerDiedError():
            return _outcome_of_deaths(MAX_DEATHS)
        case CallTookTooLongError():
            return took_too_long(case.limit_s)
        case error:  # a controller may raise anything; the other cases continue
            return _outcome_of_error(error)


def _outcome_of_future(future: "Future") -> CaseOutcome:
    from distributed.scheduler import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        return _outcome_of_deaths(error.allowed_failures + 1)
    except Exception as error:  # noqa: BLE001 - a controller may raise anything; the other cases continue
        return _outcome_of_error(error)


def _outcome_of_deaths(count: int) -> CaseOutcome:
    return CaseOutcome(error=f"its worker process died, {count} times; its memory may not suffice")


def _outcome_of_error(error: Exception) -> CaseOutcome:
    return CaseOutcome(error=f"{type(error).__name__}: {error}"[:300])

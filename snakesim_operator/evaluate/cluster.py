"""Workers of Dask: processes on this computer, or a lab's cluster, to which the same cases are sent."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import dask.config
from distributed import Client, Future, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

from snakesim_operator.dask_cluster import connected
from snakesim_operator.evaluate.case import Case, Outcome, code_digest, run_case

DEATHS, RETRIES = 4, 2  # of the workers that run a case, and of the case, until it is given up
LOOPBACK = "127.0.0.1"


@contextmanager
def workers(cluster: str | None, count: int | None = None, *, dashboard: bool = False) -> Iterator[Client]:
    """Connect to a cluster, or start one here: a process a core, reachable from this computer only.

    Raises NotConnectedError when there is no answer, ConfigError for an invalid address.
    """
    with ExitStack() as opened:
        if cluster is not None:
            yield opened.enter_context(connected(cluster))
            return
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        settings = {"distributed.scheduler.allowed-failures": DEATHS, "distributed.comm.timeouts.connect": "60s"}
        opened.enter_context(dask.config.set(settings))
        here = LocalCluster(
            n_workers=count or len(os.sched_getaffinity(0)),
            threads_per_worker=1,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:8787" if dashboard else f"{LOOPBACK}:0",
            worker_dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
            preload=["snakesim_operator.evaluate.worker"],
        )
        opened.enter_context(here)
        yield opened.enter_context(Client(here, set_as_default=False))


def size(client: Client) -> int:
    """How many workers there are now."""
    return max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)


def solve(client: Client, cases: Sequence[Case]) -> Iterator[tuple[Case, Outcome]]:
    """Run all cases; each with its outcome as it is done. Begun in the order given; no two may have one id."""
    submitted = {
        client.submit(
            run_case,
            *(case.config, code_digest(), case.give_up_s, case.limit_s),
            key=case.id,
            retries=RETRIES,
            priority=-place,  # otherwise the last comes first
        ): case
        for place, case in enumerate(cases)
    }
    for future in as_completed(submitted, loop=client.loop):
        yield submitted[future], _outcome(future)
        future.release()


def _outcome(future: Future) -> Outcome:
    try:
        return future.result()
    except KilledWorker:
        return Outcome(error=f"its worker process died, {DEATHS + 1} times; its memory may not suffice")
    except Exception as error:  # noqa: BLE001 - whatever a controller raised; the other cases go on
        return Outcome(error=f"{type(error).__name__}: {error}"[:300])

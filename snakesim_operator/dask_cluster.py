"""A lab's Dask cluster, to which evaluations and training send their runs."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from distributed import Client

from snakesim_hal.errors import ConfigError, NotConnectedError, short

MEET_S = 20.0


def check_address(address: str | None) -> None:
    """Before anything is begun for it. Raises ConfigError."""
    if address is not None and not re.fullmatch(r"(tcp|tls)://[^\s/]+:\d{1,5}", address):
        raise ConfigError(f"--cluster {short(address)}: give the scheduler as tcp://HOST:PORT")


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """Its client. Raises NotConnectedError when there is no answer, ConfigError for an invalid address."""
    check_address(address)
    try:
        client = Client(address, timeout=MEET_S, set_as_default=False)
    except (OSError, TimeoutError):
        raise NotConnectedError(f"--cluster {address}: no Dask scheduler answers within {MEET_S:g} s") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=MEET_S)
        except TimeoutError:
            raise NotConnectedError(
                f"--cluster {address}: no worker within {MEET_S:g} s; start some: dask worker {address} --nthreads 1"
            ) from None
        yield client

"""A lab's Dask cluster, to which evaluations and training send their runs."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError, NotConnectedError, shorten

if TYPE_CHECKING:  # takes a second to import, and most commands only check an address
    from distributed import Client

MEET_S = 20.0


def check_address(address: str | None) -> None:
    """Before anything is begun for it. Raises ConfigError."""
    if address is not None and not re.fullmatch(r"(tcp|tls)://[^\s/]+:\d{1,5}", address):
        raise ConfigError(
            f"--cluster {shorten(address)}: give the scheduler as tcp://HOST:PORT", code="network/invalid-address"
        )


@contextmanager
def connected(address: str) -> "Iterator[Client]":
    """Its client. Raises NotConnectedError when there is no answer, ConfigError for an invalid address."""
    from distributed import Client

    check_address(address)
    _check_certificates(address)
    try:
        client = Client(address, timeout=MEET_S, set_as_default=False)
    except (OSError, TimeoutError):
        raise NotConnectedError(
            f"--cluster {address}: no Dask scheduler answers within {MEET_S:g} s", code="network/nothing-listens"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=MEET_S)
        except TimeoutError:
            raise NotConnectedError(
                f"--cluster {address}: no worker within {MEET_S:g} s; start some: dask worker {address} --nthreads 1",
                code="network/nothing-listens",
            ) from None
        yield client


def _check_certificates(address: str) -> None:
    """Raise ConfigError for a scheduler with TLS when this computer has no certificate for it."""
    from distributed import Security

    try:
        context = Security().get_connection_args("client")["ssl_context"]
    except OSError as error:  # that of the ssl module, too
        raise ConfigError(
            f"--cluster {address}: a file of Dask's TLS configuration cannot be used: {error}",
            code="certificate/rejected",
        ) from None
    if address.startswith("tls:") and context is None:
        raise ConfigError(
            f"--cluster {address}: Dask has no certificate for TLS; name the files in its configuration, "
            "distributed.comm.tls, as docs/evaluation.md shows",
            code="certificate/rejected",
        )

"""Connects to a lab's Dask cluster, to which evaluations and training send their runs."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError, NotConnectedError, shorten

if TYPE_CHECKING:  # takes a second to import, and most commands only check an address
    from distributed import Client

CONNECT_LIMIT_S = 20.0  # for the scheduler to answer, and again for its first worker


def check_address(address: str | None) -> None:
    """Check the form of a scheduler's address. Raises ConfigError if it is not tcp://HOST:PORT or tls://HOST:PORT."""
    if address is not None and not re.fullmatch(r"(tcp|tls)://[^\s/]+:\d{1,5}", address):
        raise ConfigError(
            f"--cluster {shorten(address)}: give the scheduler as tcp://HOST:PORT", code="network/invalid-address"
        )


@contextmanager
def connected(address: str) -> "Iterator[Client]":
    """Open a client of a cluster that has at least one worker.

    Args:
        address: of the scheduler, tcp://HOST:PORT or tls://HOST:PORT.

    Raises:
        NotConnectedError: the scheduler does not answer, or it has no worker.
        ConfigError: the address is invalid, or the certificates for TLS are missing.
    """
    from distributed import Client

    check_address(address)
    _check_certificates(address)
    try:
        client = Client(address, timeout=CONNECT_LIMIT_S, set_as_default=False)
    except (OSError, TimeoutError):
        raise NotConnectedError(
            f"--cluster {address}: no Dask scheduler answers within {CONNECT_LIMIT_S:g} s",
            code="network/nothing-listens",
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_LIMIT_S)
        except TimeoutError:
            raise NotConnectedError(
                f"--cluster {address}: no worker within {CONNECT_LIMIT_S:g} s; start some: "
                f"dask worker {address} --nthreads 1",
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
            "distributed.comm.tls, as docs/how-to/evaluate-on-a-cluster.md shows",
            code="certificate/rejected",
        )

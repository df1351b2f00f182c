"""Connects to a lab's Dask cluster, to which evaluations and training send their runs."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from snakesim_hal.base.errors import ConfigError, NotConnectedError, shorten

if TYPE_CHECKING:  # takes a second to import, and most commands only check an address
    from distributed import Client

CONNECT_TIMEOUT_S = 20.0  # for the scheduler to answer, and again for its first worker


def validate_address(address: str | None) -> None:
    """Raise ConfigError if an address of a scheduler is not of the form tcp://HOST:PORT or tls://HOST:PORT.

    None is accepted: no cluster is used.
    """
    if address is not None and not re.fullmatch(r"(tcp|tls)://[^\s/]+:\d{1,5}", address):
        raise ConfigError(
            f"--cluster {shorten(address)}: give the scheduler as tcp://HOST:PORT",
            code="network/invalid-address",
        )


@contextmanager
def connect_to_cluster(address: str) -> "Iterator[Client]":
    """Connect to a Dask cluster, and wait until it has a worker.

    Args:
        address: Address of the scheduler, tcp://HOST:PORT or tls://HOST:PORT.

    Yields:
        A client of the cluster, which is closed when the context ends.

    Raises:
        NotConnectedError: The scheduler does not answer, or it has no worker.
        ConfigError: The address is invalid, or the certificates for TLS are missing.
    """
    from distributed import Client

    validate_address(address)
    _check_tls_certificates(address)
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError):
        raise NotConnectedError(
            f"--cluster {address}: no Dask scheduler answers within {CONNECT_TIMEOUT_S:g} s",
            code="network/nothing-listens",
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        except TimeoutError:
            raise NotConnectedError(
                f"--cluster {address}: no worker within {CONNECT_TIMEOUT_S:g} s; start some: "
                f"dask worker {address} --nthreads 1",
                code="network/nothing-listens",
            ) from None
        yield client


def _check_tls_certificates(address: str) -> None:
    """Raise ConfigError if a scheduler uses TLS, but this computer has no valid certificate for it."""
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

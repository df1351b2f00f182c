"""Waits for a network that another process opens."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import ConnectionSettings, Session, open_session

CONNECT_ATTEMPT_S = 2.0  # for one attempt to connect: `keeps_waiting` is called so often


@contextmanager
def open_session_when_ready(
    connection: ConnectionSettings, keeps_waiting: Callable[[], bool]
) -> Iterator[Session]:
    """Connect as soon as the robot's network accepts connections, and close the session when the context ends.

    After each failed attempt the caller decides whether to try again, so that a waiting process can be ended in order.

    Args:
        connection: Endpoint to connect to, and how.
        keeps_waiting: Is called after each attempt that failed; returns whether to try again.

    Yields:
        The session.

    Raises:
        NotConnectedError: `keeps_waiting` returned False.
    """
    with ExitStack() as stack:
        while True:
            try:
                session = stack.enter_context(
                    open_session(connection, connect_timeout_s=CONNECT_ATTEMPT_S)
                )
                break
            except NotConnectedError:
                if not keeps_waiting():
                    raise
        yield session

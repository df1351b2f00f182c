"""Waits for a network that another process opens."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import Link, Session, open_session

# The time for one attempt to connect, which a stop signal has to wait for. It doubles with each attempt: the first ones
# let a process end soon, and a busy computer needs the last ones.
FIRST_ATTEMPT_S = 0.5
MAX_ATTEMPT_S = 2.0


@contextmanager
def open_session_when_ready(link: Link, keeps_waiting: Callable[[], bool]) -> Iterator[Session]:
    """Connect as soon as there is a network, and close the session when the context ends.

    Between two attempts the caller decides whether to go on, so that a process that waits can be ended in order.

    Args:
        link: where and how to connect.
        keeps_waiting: is called after each attempt that failed; returns whether to try again.

    Yields:
        The session.

    Raises:
        NotConnectedError: `keeps_waiting` returned False.
    """
    attempt_s = FIRST_ATTEMPT_S
    with ExitStack() as stack:
        while True:
            try:
                session = stack.enter_context(open_session(link, connect_timeout_s=attempt_s))
                break
            except NotConnectedError:
                if not keeps_waiting():
                    raise
                attempt_s = min(2 * attempt_s, MAX_ATTEMPT_S)
        yield session

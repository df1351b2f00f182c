"""Waits until a router has logged or relayed messages."""

import time
from collections.abc import Callable
from typing import Any

import zenoh

LIMIT_S = 30.0
POLL_PERIOD_S = 0.02


def eventually(what: Callable[[], Any], wanted: Any) -> None:
    """Wait until a function returns a wanted value, because a log is read a moment after it is written.

    Args:
        what: The function, which is called again and again.
        wanted: The value.
    """
    deadline = time.monotonic() + LIMIT_S
    while (value := what()) != wanted and time.monotonic() < deadline:
        time.sleep(POLL_PERIOD_S)
    assert value == wanted


def settle(*sessions: zenoh.Session) -> None:
    """Wait until the router has handled all messages of these sessions, and the sessions those of the router.

    A liveliness query passes the router in both directions. Two rounds of queries cover messages between sessions.
    """
    for session in (*sessions, *sessions):
        list(session.liveliness().get("unused/key", timeout=1.0))
        time.sleep(POLL_PERIOD_S)

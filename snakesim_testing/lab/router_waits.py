"""Wait for what a router lets pass."""

import time
from collections.abc import Callable
from typing import Any

import zenoh


def eventually(what: Callable[[], Any], wanted: Any) -> None:
    """The log is read a moment after it is written."""
    deadline = time.monotonic() + 30.0
    while (found := what()) != wanted and time.monotonic() < deadline:
        time.sleep(0.02)
    assert found == wanted


def settle(*sessions: zenoh.Session) -> None:
    """Until the router has handled what these have sent, and they what it lets pass."""
    for session in (*sessions, *sessions):
        list(session.liveliness().get("unused/key", timeout=1.0))  # there and back
        time.sleep(0.02)

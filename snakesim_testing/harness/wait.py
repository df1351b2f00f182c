"""Waits for a condition until a deadline."""

import time
from collections.abc import Callable
from typing import TypeVar

# Ends a test that hangs. A command that computes for 15 s once took over 90 s on a machine with load 13.
TIMEOUT_S = 240.0
FoundT = TypeVar("FoundT")


def wait_until(
    condition: Callable[[], FoundT | None], what: str, limit_s: float = TIMEOUT_S
) -> FoundT:
    """Wait until a condition returns a true value, and return this value.

    Args:
        condition: Returns a true value once the condition holds.
        what: Description of the condition, for the failure.
        limit_s: Time after which this fails.
    """
    deadline = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(0.01)
    return found

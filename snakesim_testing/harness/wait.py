"""Wait on a condition, with a deadline."""

import time
from collections.abc import Callable
from typing import TypeVar

# Long enough for a process to start on a busy machine; a caller may give another limit.
TIMEOUT_S = 90.0
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

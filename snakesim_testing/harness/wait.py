"""Wait on a condition, with a deadline."""

import time
from collections.abc import Callable
from typing import TypeVar

LIMIT_S = 90.0  # long enough for a process to start on a busy machine; a caller may give another limit
FoundT = TypeVar("FoundT")


def wait_until(condition: Callable[[], FoundT | None], what: str, limit_s: float = LIMIT_S) -> FoundT:
    """Poll a condition; what it found. Fails with its name when it does not hold in time."""
    deadline = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(0.01)
    return found

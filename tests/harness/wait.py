"""Wait on a condition, with a deadline."""

import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 90.0  # long enough for a process to start on a busy machine; whoever states a time gives its own


def wait_until(condition: Callable[[], Any], what: str, limit_s: float = LIMIT_S) -> None:
    """Poll a condition; fails with its name when it does not hold in time."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(0.01)

"""Waits until a viewer of the console has received something."""

import asyncio
from collections.abc import Callable
from typing import TypeVar

LIMIT_S = 60.0
POLL_PERIOD_S = 0.02

T = TypeVar("T")


async def wait_for_condition(condition: Callable[[], T | None], description: str) -> T:
    """Wait until a condition returns a true value, and return that value.

    Args:
        condition: Called again and again while other tasks of the event loop run.
        description: Names what the test waits for, for the failure message.
    """
    deadline = asyncio.get_running_loop().time() + LIMIT_S
    while not (value := condition()):
        is_in_time = asyncio.get_running_loop().time() < deadline
        assert is_in_time, f"{description}: did not happen within {LIMIT_S:g} s"
        await asyncio.sleep(POLL_PERIOD_S)
    return value

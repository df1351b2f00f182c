"""Wait for what a viewer of the console receives."""

import asyncio
from collections.abc import Callable
from typing import TypeVar

LIMIT_S = 60.0


T = TypeVar("T")


async def until(condition: Callable[[], T | None], what: str) -> T:
    deadline = asyncio.get_running_loop().time() + LIMIT_S
    while not (found := condition()):
        assert asyncio.get_running_loop().time() < deadline, f"not in time: {what}"
        await asyncio.sleep(0.02)
    return found

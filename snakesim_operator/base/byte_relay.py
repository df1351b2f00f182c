"""Relays what two connections receive, in both directions."""

import asyncio
import contextlib
from collections.abc import Coroutine
from typing import Any

CHUNK_BYTES = 64 * 1024

Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def relay_bytes(one: Connection, other: Connection) -> None:
    """Copy bytes in both directions until either side closes its connection. The caller closes both."""
    await run_until_one_ends(_copy(one[0], other[1]), _copy(other[0], one[1]))


async def run_until_one_ends(*directions: Coroutine[Any, Any, None]) -> None:
    """Run the directions of a relay until one of them ends, and cancel the others."""
    tasks = [asyncio.ensure_future(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy bytes as fast as the receiver takes them."""
    with contextlib.suppress(OSError):
        while data := await reader.read(CHUNK_BYTES):
            writer.write(data)
            await writer.drain()

"""Relays bytes between two connections, in both directions."""

import asyncio
import contextlib
from collections.abc import Coroutine
from typing import Any

CHUNK_BYTES = 64 * 1024

Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def relay_bytes(first: Connection, second: Connection) -> None:
    """Copy bytes in both directions until either side closes its connection. The caller closes both."""
    await run_until_one_ends(_copy_bytes(first[0], second[1]), _copy_bytes(second[0], first[1]))


async def run_until_one_ends(*directions: Coroutine[Any, Any, None]) -> None:
    """Run the directions of a relay until one of them ends, and cancel the others."""
    tasks = [asyncio.ensure_future(direction) for direction in directions]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _copy_bytes(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy bytes from a reader to a writer, as fast as the receiver accepts them, until either side ends."""
    with contextlib.suppress(OSError):
        while data := await reader.read(CHUNK_BYTES):
            writer.write(data)
            await writer.drain()

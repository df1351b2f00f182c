"""Relays TCP connections, and can stall them: the relay holds all data back, and delivers it at once later."""

import asyncio
import contextlib

CHUNK_BYTES = 64 * 1024


class StallingRelay:
    """Relays connections from a port of its own to another address. It is an async context manager."""

    def __init__(self, host: str, port: int) -> None:
        """Relay to this host and port."""
        self._target = (host, port)
        self._may_pass = asyncio.Event()
        self._may_pass.set()
        self._copy_tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> "StallingRelay":
        self._server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
        self.port: int = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in self._copy_tasks:
            task.cancel()

    def stall(self) -> None:
        """Hold back all data in both directions from now on."""
        self._may_pass.clear()

    def go_on(self) -> None:
        """Deliver the data that was held back, and relay again."""
        self._may_pass.set()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        target_reader, target_writer = await asyncio.open_connection(*self._target)
        tasks = [
            asyncio.create_task(self._copy(reader, target_writer)),
            asyncio.create_task(self._copy(target_reader, writer)),
        ]
        self._copy_tasks.update(tasks)
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for stream in (writer, target_writer):
            stream.close()

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(CHUNK_BYTES):
                await self._may_pass.wait()
                writer.write(data)
                await writer.drain()

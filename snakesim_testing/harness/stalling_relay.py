"""A TCP connection through a relay that can stall: what is sent waits, and comes all at once when it goes on."""

import asyncio
import contextlib

CHUNK_BYTES = 64 * 1024


class StallingRelay:
    """Relays connections from a port of its own to another port of the loopback. An async context manager."""

    def __init__(self, host: str, port: int) -> None:
        """host, port: where it relays to."""
        self._behind = host, port
        self._goes_on = asyncio.Event()
        self._goes_on.set()
        self._ways: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> "StallingRelay":
        self._server = await asyncio.start_server(self._relay, "127.0.0.1", 0)
        self.port: int = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for way in self._ways:
            way.cancel()

    def stall(self) -> None:
        """Hold back everything, in both directions, from now on."""
        self._goes_on.clear()

    def go_on(self) -> None:
        """Deliver what was held back."""
        self._goes_on.set()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        behind, to_behind = await asyncio.open_connection(*self._behind)
        ways = [
            asyncio.create_task(self._copy(reader, to_behind)),
            asyncio.create_task(self._copy(behind, writer)),
        ]
        self._ways.update(ways)
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for end in (writer, to_behind):
            end.close()

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(CHUNK_BYTES):
                await self._goes_on.wait()
                writer.write(data)
                await writer.drain()

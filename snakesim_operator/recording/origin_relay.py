"""In front of Foxglove's server, which lets any web page in: relays connections of those who may read the robot."""

import asyncio
import contextlib
import secrets
import threading
from collections.abc import Callable, Collection

from snakesim_hal.base.errors import NotConnectedError
from snakesim_operator.base.page_origin import why_head_refused

HOST = "127.0.0.1"
LONGEST_HEAD = 16 * 1024
HEAD_S = 5.0  # for a client to say what it wants
AT_ONCE = 64  # connections
CHUNK = 64 * 1024


def hidden_host() -> str:
    """An address of loopback that no page can guess: with a port of its own it is one of some 2^37."""
    return "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))


class OriginRelay:
    """Listens, and relays to a server behind it whatever is sent after a request that may pass."""

    def __init__(
        self, port: int, behind: tuple[str, int], also: Collection[str], report: Callable[[str], None]
    ) -> None:
        """Listen. Raises NotConnectedError when the port is in use.

        port: 0 takes any; behind: the server; also: further origins that may connect; report: told of each refusal.
        """
        self._behind, self._also, self._report = behind, also, report
        self._told: set[str] = set()
        self._connections: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(
                asyncio.start_server(self._serve, HOST, port, limit=LONGEST_HEAD)
            )
        except OSError as error:
            self._loop.close()
            raise NotConnectedError(
                f"cannot serve Foxglove on port {port}: {error.strerror}; choose another"
            ) from error
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="origin relay", daemon=True)
        self._thread.start()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            if len(self._connections) <= AT_ONCE:
                await self._relay(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # one of both is gone, or never was one of ours
        finally:
            self._connections.discard(task)
            writer.close()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
        why = why_head_refused(head, self._also)
        if why is not None:
            if why not in self._told and len(self._told) < AT_ONCE:
                self._told.add(why)
                self._report(f"Foxglove: refused a viewer: {why}; if you trust it: --foxglove-origin ORIGIN")
            writer.write(b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
            await writer.drain()
            return
        behind, to_behind = await asyncio.open_connection(*self._behind)
        try:
            to_behind.write(head)
            ways = [asyncio.ensure_future(_copy(reader, to_behind)), asyncio.ensure_future(_copy(behind, writer))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
        finally:
            to_behind.close()

    def close(self) -> None:
        """Let nobody in any more, and hang up."""
        asyncio.run_coroutine_threadsafe(self._hang_up(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _hang_up(self) -> None:
        self._server.close()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """As fast as the receiver takes it: what is too much for it is dropped by the server, which knows messages."""
    with contextlib.suppress(OSError):
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()

"""A relay in front of Foxglove's server, which itself accepts any web page: it checks who connects first.

Data flow: viewer -> relay on loopback (checks the request's head) -> Foxglove's server on a hidden address.
"""

import asyncio
import secrets
import threading
from collections.abc import Callable, Collection

from snakesim_hal.base.errors import NotConnectedError
from snakesim_operator.base.byte_relay import relay_bytes
from snakesim_operator.base.page_origin import explain_request_refusal

HOST = "127.0.0.1"
MAX_HEADER_BYTES = 16 * 1024
HEADER_TIMEOUT_S = 5.0
MAX_CONNECTIONS = 64
MAX_REASONS_REPORTED = 64  # a page could otherwise fill the terminal
END_OF_HEADER = b"\r\n\r\n"
FORBIDDEN_RESPONSE = b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


def choose_random_loopback_host() -> str:
    """Return a random loopback address. A page cannot guess it: with its port it is one of about 2^37."""
    octets = [str(1 + secrets.randbelow(254)) for _ in range(3)]
    return "127." + ".".join(octets)


class OriginRelay:
    """Listens on loopback, and connects each viewer that may read the robot with the server behind the relay."""

    def __init__(
        self,
        port: int,
        server: tuple[str, int],
        origins: Collection[str],
        report: Callable[[str], None],
    ) -> None:
        """Start to listen for viewers, in a thread. Those of unknown web pages are refused.

        Args:
            port: Port on loopback; 0 takes any free one.
            server: Host and port of the server behind the relay.
            origins: Origins of web pages that may connect, besides local ones.
            report: Gets a line of text for each kind of refusal.

        Raises:
            NotConnectedError: The port is in use.
        """
        self._server_address = server
        self._origins = origins
        self._report = report
        self._reported_reasons: set[str] = set()  # reasons
        self._connections: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        try:
            listening = asyncio.start_server(
                self._serve_connection, HOST, port, limit=MAX_HEADER_BYTES
            )
            self._listener = self._loop.run_until_complete(listening)
        except OSError as error:
            self._loop.close()
            raise NotConnectedError(
                f"cannot serve Foxglove on port {port}: {error.strerror}; choose another",
                code="network/port-in-use",
            ) from error
        self.port: int = self._listener.sockets[0].getsockname()[1]
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="origin relay", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Refuse new connections, and close the present ones."""
        asyncio.run_coroutine_threadsafe(self._disconnect_all(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _disconnect_all(self) -> None:
        self._listener.close()
        for task in list(self._connections):
            task.cancel()
        await asyncio.gather(*self._connections, return_exceptions=True)

    async def _serve_connection(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Serve one connection until either side closes it."""
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        try:
            if len(self._connections) <= MAX_CONNECTIONS:
                await self._check_and_relay(reader, writer)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a peer has left, or did not send a proper request
        finally:
            self._connections.discard(task)
            writer.close()

    async def _check_and_relay(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        request_header = await asyncio.wait_for(reader.readuntil(END_OF_HEADER), HEADER_TIMEOUT_S)
        refusal = explain_request_refusal(request_header, self._origins)
        if refusal is not None:
            self._report_refusal(refusal)
            writer.write(FORBIDDEN_RESPONSE)
            await writer.drain()
            return
        await self._relay_connection(request_header, reader, writer)

    def _report_refusal(self, reason: str) -> None:
        """Report each reason once."""
        if (
            reason not in self._reported_reasons
            and len(self._reported_reasons) < MAX_REASONS_REPORTED
        ):
            self._reported_reasons.add(reason)
            self._report(
                f"Foxglove: refused a viewer: {reason}; if you trust it: --foxglove-origin ORIGIN"
            )

    async def _relay_connection(
        self, request_header: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Pass a viewer's request on, and copy bytes in both directions until one of the sides closes its connection.

        For a slow viewer the server drops whole messages; this relay does not know where a message ends.
        """
        from_server, to_server = await asyncio.open_connection(*self._server_address)
        try:
            to_server.write(request_header)
            await relay_bytes((reader, writer), (from_server, to_server))
        finally:
            to_server.close()

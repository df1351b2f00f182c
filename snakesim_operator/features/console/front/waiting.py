"""Connections that wait until the head of their first request is complete.

A flood opens thousands of them in a second. So they cost little: each is a protocol without a task or timer of its own.
"""

import asyncio
from collections.abc import Callable

from snakesim_operator.features.console.front.requests import END_OF_HEAD, MAX_HEAD_BYTES

Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]
OnHead = Callable[[bytes, Connection], None]


class WaitingConnections:
    """The connections without a complete request, oldest first."""

    def __init__(self, max_connections: int, on_head: OnHead) -> None:
        """Have no connection yet.

        Args:
            max_connections: Of more, the oldest one is closed.
            on_head: Called with the head of a first request, and its connection, which does not wait any more.
        """
        self._max_connections = max_connections
        self._on_head = on_head
        self._since_s: dict[WaitingConnection, float] = {}

    def create(self) -> "WaitingConnection":
        """Return a protocol for a new connection."""
        return WaitingConnection(self)

    def add(self, connection: "WaitingConnection") -> None:
        """Add a connection, and close the oldest one if there are too many."""
        self._since_s[connection] = asyncio.get_running_loop().time()
        if len(self._since_s) > self._max_connections:
            self._abort_connection(next(iter(self._since_s)))

    def remove(self, connection: "WaitingConnection") -> None:
        """Forget a connection that was closed."""
        self._since_s.pop(connection, None)

    def finish(self, connection: "WaitingConnection", head: bytes, rest: bytes) -> None:
        """Pass on a connection whose request is complete. `rest` are the bytes after its head."""
        self.remove(connection)
        reader = asyncio.StreamReader(limit=MAX_HEAD_BYTES)
        protocol = asyncio.StreamReaderProtocol(reader)
        connection.transport.set_protocol(protocol)
        protocol.connection_made(connection.transport)
        reader.feed_data(rest)
        loop = asyncio.get_running_loop()
        self._on_head(
            head, (reader, asyncio.StreamWriter(connection.transport, protocol, reader, loop))
        )

    def abort_older_than(self, age_s: float) -> None:
        """Close the connections that have waited for longer."""
        before_s = asyncio.get_running_loop().time() - age_s
        for connection in [
            connection for connection, since_s in self._since_s.items() if since_s < before_s
        ]:
            self._abort_connection(connection)

    def _abort_connection(self, connection: "WaitingConnection") -> None:
        self.remove(connection)
        connection.transport.abort()


class WaitingConnection(asyncio.Protocol):
    """One connection, and what has arrived of its request."""

    transport: asyncio.Transport

    def __init__(self, waiting: WaitingConnections) -> None:
        """Have received nothing yet."""
        self._waiting = waiting
        self._received = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to wait."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._waiting.add(self)

    def data_received(self, data: bytes) -> None:
        """Pass the connection on once the head of its request is complete. Close it if the head is too long."""
        self._received += data
        head, end, rest = self._received.partition(END_OF_HEAD)
        if len(head) > MAX_HEAD_BYTES:
            self.transport.abort()
        elif end:
            self._waiting.finish(self, head + end, rest)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._waiting.remove(self)

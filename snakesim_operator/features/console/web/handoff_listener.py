"""A listening socket for viser's server, which gets its connections from `connection_acceptor`."""

import contextlib
import socket
from collections import deque


class HandoffListener(socket.socket):
    """A listening socket for a server of asyncio, whose `accept` returns the connections that were handed off to it.

    It is one end of a pair of sockets. A byte sent at the other end wakes the server.
    """

    def __init__(self, address: tuple[str, int]) -> None:
        """Have no connection yet. address: where the connections were accepted."""
        listening_end, self._wake_end = socket.socketpair()
        super().__init__(listening_end.family, listening_end.type, fileno=listening_end.detach())
        self._wake_end.setblocking(False)
        self._address = address
        self._connections: deque[socket.socket] = deque()

    def hand_off(self, connection: socket.socket) -> None:
        """Hand a connection off to the server; from any thread."""
        self._connections.append(connection)
        with contextlib.suppress(OSError):  # full of bytes: the server is being woken already
            self._wake_end.send(b"\0")

    def listen(self, backlog: int = 0, /) -> None:
        """Do nothing: another socket listens."""

    def getsockname(self) -> tuple[str, int]:
        """Return the address at which the connections were accepted."""
        return self._address

    def accept(self) -> tuple[socket.socket, object]:
        """Return the next connection and the address of its other end.

        Raises:
            BlockingIOError: There is no connection.
        """
        if not self._connections:
            self.recv(4096)  # the wake-up bytes; a connection added before they were read is seen below
            if not self._connections:
                raise BlockingIOError
        connection = self._connections.popleft()
        with contextlib.suppress(OSError):
            return connection, connection.getpeername()
        return connection, self._address

    def close(self) -> None:
        """Close the listener, and all connections that the server has not accepted."""
        for connection in self._connections:
            connection.close()
        self._wake_end.close()
        super().close()

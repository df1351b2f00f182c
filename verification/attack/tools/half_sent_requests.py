"""Keeps half-sent HTTP requests open at a console, as a process of its own.

    python -m verification.attack.tools.half_sent_requests HOST PORT COUNT

It prints "ready" after its first attempt to open all of them, and opens each again that the console closes. It ends
when its standard input is closed.
"""

import contextlib
import os
import resource
import select
import socket
import sys
import threading
import time
from collections.abc import Iterator
from itertools import cycle

# Beginnings of requests for the page, for the second stop and for its state, and a connection without any byte.
HALF_REQUESTS = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
    b"POST /stop HTTP/1.1\r\nHost: ",
    b"GET /sig",
    b"",
)
CONNECT_TIMEOUT_S = 0.2
# Pause between two checks for closed connections, so that other processes of this computer get some time.
CHECK_PERIOD_S = 0.02
MAX_EVENTS = 4096  # closed connections that one check handles


class HalfSentRequests:
    """Half-sent requests at one address."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._next_half_requests: Iterator[bytes] = cycle(HALF_REQUESTS)
        self._connections: dict[int, socket.socket] = {}  # by file descriptor
        self._poller = select.epoll()

    def __len__(self) -> int:
        return len(self._connections)

    def open_until(self, count: int) -> None:
        """Open requests until there are `count`, or until the server accepts no more."""
        for _ in range(count - len(self)):
            connection = socket.socket()
            connection.settimeout(CONNECT_TIMEOUT_S)
            try:
                connection.connect(self._address)
                connection.send(next(self._next_half_requests))
            except OSError:
                connection.close()
                return
            self._connections[connection.fileno()] = connection
            self._poller.register(connection, select.EPOLLIN | select.EPOLLRDHUP)

    def discard_closed(self) -> None:
        """Discard the requests that the server has answered or closed."""
        for descriptor, _ in self._poller.poll(0, MAX_EVENTS):
            with contextlib.suppress(OSError):
                self._poller.unregister(descriptor)
            self._connections.pop(descriptor).close()


def main() -> None:
    """Keep half-sent requests open until standard input is closed."""
    host = sys.argv[1]
    port = int(sys.argv[2])
    count = int(sys.argv[3])
    _raise_file_limit()
    threading.Thread(target=_exit_with_standard_input, daemon=True).start()
    requests = HalfSentRequests(host, port)
    requests.open_until(count)
    print(f"ready: {len(requests)} half-sent requests", flush=True)
    while True:
        requests.discard_closed()
        time.sleep(CHECK_PERIOD_S)
        requests.open_until(count)


def _raise_file_limit() -> None:
    """Allow this process as many open files as the system permits."""
    _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard_limit, hard_limit))


def _exit_with_standard_input() -> None:
    """End this process when its standard input is closed."""
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()

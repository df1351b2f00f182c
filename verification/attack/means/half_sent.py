"""Holds half-sent HTTP requests open at a console: `python -m verification.attack.means.half_sent HOST PORT COUNT`.

It prints "ready" once it has tried to open all of them, opens each again that is closed, and ends with its standard
input.
"""

import contextlib
import os
import resource
import select
import socket
import sys
import threading
import time
from itertools import cycle

# What is sent on one connection after the other: for the pages, for the backup stop, and nothing at all.
HALVES = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n",
    b"POST /stop HTTP/1.1\r\nHost: ",
    b"GET /sig",
    b"",
)
# Between two looks at closed connections: other processes of this computer get some time.
PAUSE_S = 0.02


def main() -> None:
    """Until standard input closes."""
    host, port, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0)), daemon=True).start()
    halves, opened, poller = cycle(HALVES), dict[int, socket.socket](), select.epoll()
    told = False
    while True:
        for _ in range(count - len(opened)):
            connection = socket.socket()
            connection.settimeout(0.2)
            try:
                connection.connect((host, port))
                connection.send(next(halves))
            except OSError:
                connection.close()
                break
            opened[connection.fileno()] = connection
            poller.register(connection, select.EPOLLIN | select.EPOLLRDHUP)
        if not told:
            told = True
            print(f"ready: {len(opened)} half-sent requests", flush=True)
        for descriptor, _ in poller.poll(0, 4096):
            with contextlib.suppress(OSError):
                poller.unregister(descriptor)
            opened.pop(descriptor).close()
        time.sleep(PAUSE_S)


if __name__ == "__main__":
    main()

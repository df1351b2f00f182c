"""In front of the pages: accepts each connection, and answers those of the second stop itself.

A stop over `POST /stop` shares nothing with the pages but the port: no websocket, no viser, no event loop, a thread of
its own. All other connections are handed on to viser's server as they came.
"""

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable

from snakesim_hal.errors import SnakesimError
from snakesim_operator.page_origin import why_head_refused

PATH = "/stop"
OURS = tuple(f"{method} {PATH} ".encode() for method in ("GET", "POST"))
LONGEST_HEAD = 16 * 1024
UNDECIDED = 256  # connections that have not said what they want; a browser opens some ahead of need
CONFIRMING_S = 10.0  # browsers and clients ask within this, or are forgotten
REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 503: "Service Unavailable"}


class HandedOn(socket.socket):
    """What a server of asyncio takes for its listening socket: `accept` returns the connections that were put here."""

    def __init__(self, address: tuple[str, int]) -> None:
        """address: where they were accepted."""
        ready, self._bell = socket.socketpair()
        super().__init__(ready.family, ready.type, fileno=ready.detach())
        self._bell.setblocking(False)
        self._address = address
        self._waiting: deque[socket.socket] = deque()

    def put(self, connection: socket.socket) -> None:
        """Hand one on; from any thread."""
        self._waiting.append(connection)
        with contextlib.suppress(OSError):  # full: it rings already
            self._bell.send(b"\0")

    def listen(self, backlog: int = 0, /) -> None:
        """It is listened elsewhere."""

    def getsockname(self) -> tuple[str, int]:
        """Where they were accepted."""
        return self._address

    def accept(self) -> tuple[socket.socket, object]:
        """The next one. Raises BlockingIOError when there is none."""
        if not self._waiting:
            self.recv(4096)  # one that was put before its bell was read is seen below
            if not self._waiting:
                raise BlockingIOError
        connection = self._waiting.popleft()
        with contextlib.suppress(OSError):
            return connection, connection.getpeername()
        return connection, self._address

    def close(self) -> None:
        """And all that nobody has taken."""
        for connection in self._waiting:
            connection.close()
        self._bell.close()
        super().close()


class Front:
    """The thread that accepts. A context manager."""

    def __init__(
        self,
        listening: socket.socket,
        handed_on: HandedOn,
        stop: Callable[[], str] | None,
        refused: Callable[[str], None] = lambda _: None,
    ) -> None:
        """stop: stops the robot, returns what came of it or raises SnakesimError; None: there is nothing to stop.

        refused: told why a page was refused.
        """
        self._listening, self._handed_on, self._stop, self._refused = listening, handed_on, stop, refused
        self._heads: dict[socket.socket, tuple[float, bytearray]] = {}  # since when, and what is read of those of PATH
        self._asking: list[socket.socket] = []
        self._stopping = False
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._thread = threading.Thread(target=self._serve, name="front", daemon=True)

    def __enter__(self) -> "Front":
        self._listening.setblocking(False)
        self._selector.register(self._listening, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join()
        for connection in self._heads:
            connection.close()
        self._selector.close()
        self._listening.close()

    def _serve(self) -> None:
        while not self._closed.is_set():
            for key, _ in self._selector.select(0.1):
                if key.fileobj is self._listening:
                    self._accept()
                elif isinstance(key.fileobj, socket.socket) and key.fileobj in self._heads:
                    self._read(key.fileobj)
            old_s = time.monotonic() - CONFIRMING_S
            for connection in [one for one, (since_s, head) in self._heads.items() if head and since_s < old_s]:
                self._forget(connection).close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listening.accept()
        except BlockingIOError:
            return
        except OSError:  # no file handles left, or a client that has gone
            self._closed.wait(0.05)
            return
        connection.setblocking(False)
        if len(self._heads) >= UNDECIDED:
            self._forget(next(iter(self._heads))).close()
        self._heads[connection] = time.monotonic(), bytearray()
        self._selector.register(connection, selectors.EVENT_READ)

    def _forget(self, connection: socket.socket) -> socket.socket:
        self._selector.unregister(connection)
        del self._heads[connection]
        return connection

    def _read(self, connection: socket.socket) -> None:
        head = self._heads[connection][1]
        try:
            if not head and not connection.recv(len(OURS[1]), socket.MSG_PEEK).startswith(OURS):
                self._handed_on.put(self._forget(connection))
                return
            data = connection.recv(4096)
        except OSError:
            data = b""
        head += data
        if b"\r\n\r\n" in head:
            self._answer(self._forget(connection), bytes(head))
        elif not data or len(head) > LONGEST_HEAD:
            self._forget(connection).close()

    def _answer(self, connection: socket.socket, request: bytes) -> None:
        why = why_head_refused(request.partition(b"\r\n\r\n")[0])
        if why is not None:
            self._refused(why)
            _respond(connection, 403, why)
        elif self._stop is None:
            _respond(connection, 503, "a recording has nothing to stop")
        elif request.startswith(b"GET "):
            _respond(connection, 200, "ready")
        else:
            self._ask(connection)

    def _ask(self, connection: socket.socket) -> None:
        """Stop the robot, beside this thread. Who asks meanwhile gets a stop that begins after the present one."""
        with self._lock:
            self._asking.append(connection)
            if self._stopping:
                return
            self._stopping = True
        threading.Thread(target=self._stop_for_all, name="second stop", daemon=True).start()

    def _stop_for_all(self) -> None:
        assert self._stop is not None
        while True:
            with self._lock:
                asking, self._asking = self._asking, []
                self._stopping = bool(asking)
            if not asking:
                return
            try:
                status, text = 200, self._stop()
            except SnakesimError as error:
                status, text = 503, str(error)
            for connection in asking:
                _respond(connection, status, text)


def _respond(connection: socket.socket, status: int, text: str) -> None:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    with contextlib.suppress(OSError), connection:
        connection.send(head.encode() + body)  # far less than a new connection's buffer
        connection.shutdown(socket.SHUT_WR)

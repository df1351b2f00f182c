"""In front of the pages: accepts each connection, and answers those of the second stop itself.

A stop over `POST /stop` shares nothing with the pages but the port: no websocket, no viser, no event loop, a thread of
its own. All other connections are handed on to viser's server as they came, once their request is complete.

No number of connections keeps a stop from being asked for. Requests that are not complete are limited in number, in
total and of one user, and in time; of too many the oldest one is closed. So are connections to the pages. Should the
file table be full all the same, a reserved descriptor is given up to accept the next connection.
"""

import contextlib
import errno
import os
import resource
import select
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Protocol

from snakesim_hal.base.workers import start_worker
from snakesim_operator.base.page_origin import why_head_refused
from snakesim_operator.features.console.web.connection_limits import (
    ConnectionLimits,
    PendingRequests,
    choose_limits,
    why_no_page,
)
from snakesim_operator.features.console.web.peer_user import PeerUsers

PATH = "/stop"
OURS = tuple(f"{method} {PATH} ".encode() for method in ("GET", "POST"))
END_OF_HEAD = b"\r\n\r\n"
MAX_HEAD_BYTES = 16 * 1024
HEAD_LIMIT_S = 10.0  # from the connection to the end of its request
BACKLOG = 1024  # connections that the kernel keeps until they are accepted; it may have a lower limit
ACCEPTED_AT_ONCE = 128  # before those that are waiting are looked at again
RESERVED_DESCRIPTORS = 4
OUT_OF_FILES = (errno.EMFILE, errno.ENFILE)
REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 503: "Service Unavailable"}


class Readiness(Protocol):
    """Whether a stop would reach the robot."""

    @property
    def ready(self) -> bool:
        """Whether it would."""
        ...

    @property
    def text(self) -> str:
        """The same in words."""
        ...


class StopPath(Protocol):
    """What stops the robot, and tests itself. None of its methods waits."""

    def request(self, requester: str) -> "Future[str]":
        """Stop the robot; the future has the result in words, or an error."""
        ...

    def readiness(self) -> Readiness:
        """Return the result of the newest self-test."""
        ...

    def test_if_due(self) -> None:
        """Begin a self-test, if it is time for one."""
        ...


class HandoffListener(socket.socket):
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


class ReservedDescriptors:
    """Open descriptors of nothing, given up when the file table is full, and taken again when it is not."""

    def __init__(self, count: int) -> None:
        """Open so many."""
        self._count = count
        self._held: list[int] = []
        self.refill()

    def refill(self) -> None:
        """Open those that were given up, as far as the file table has room."""
        with contextlib.suppress(OSError):
            while len(self._held) < self._count:
                self._held.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def give_up_one(self) -> bool:
        """Close one, so that another file can be opened; whether there was one."""
        if not self._held:
            return False
        os.close(self._held.pop())
        return True

    def close(self) -> None:
        """Close all of them."""
        while self.give_up_one():
            pass


class ConnectionAcceptor:
    """The thread that accepts. A context manager."""

    def __init__(
        self,
        listening: socket.socket,
        handed_on: HandoffListener,
        stop: StopPath | None,
        refused: Callable[[str, str], None] = lambda _kind, _why: None,
        limits: ConnectionLimits | None = None,
    ) -> None:
        """Open what it needs, but accept nothing yet.

        Args:
            listening: Where browsers connect.
            handed_on: Gets the connections that are not for the second stop.
            stop: Stops the robot; None for a recording, where there is nothing to stop.
            refused: Called with a kind and a reason for each connection that is refused.
            limits: None: by the number of files that this process may open.
        """
        self._listening, self._handed_on, self._stop, self._refused = listening, handed_on, stop, refused
        self._limits = choose_limits(*_files()) if limits is None else limits
        # Connections, by what they are at. A stop answers those that asked for it in another thread.
        self._waiting: PendingRequests[socket.socket] = PendingRequests(self._limits)
        self._pages: dict[socket.socket, int] = {}  # their users
        self._asking = 0
        self._asking_changed = threading.Lock()
        self._current: socket.socket | None = None  # the one that is looked at
        # Owned from the start: a stop must not depend on what can be opened then.
        self._users = PeerUsers()
        self._reserved = ReservedDescriptors(RESERVED_DESCRIPTORS)
        self._poll = select.epoll()
        self._by_descriptor: dict[int, socket.socket] = {}
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> "ConnectionAcceptor":
        self._listening.setblocking(False)
        self._listening.listen(BACKLOG)
        self._poll.register(self._listening, select.EPOLLIN)
        self._thread = start_worker("front", self._serve, is_over=self._closed.is_set, on_error=self._drop_current)
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        assert self._thread is not None
        self._thread.join()
        for connection in self._waiting.list_all():
            connection.close()
        self._poll.close()
        self._users.close()
        self._reserved.close()
        self._listening.close()

    def _serve(self) -> None:
        while not self._closed.is_set():
            for descriptor, _ in self._poll.poll(0.1):
                if descriptor == self._listening.fileno():
                    self._accept_all()
                elif descriptor in self._by_descriptor:
                    self._look_at(self._by_descriptor[descriptor])
            for late in self._waiting.list_older_than(time.monotonic() - HEAD_LIMIT_S):
                self._forget(late)
                late.close()
            self._reserved.refill()
            if self._stop is not None:
                self._stop.test_if_due()

    def _drop_current(self, _error: Exception) -> None:
        """Close the connection at which an unexpected error was raised."""
        connection, self._current = self._current, None
        if connection is not None:
            if connection in self._waiting:
                self._forget(connection)
            connection.close()

    # --- connections

    def _accept_all(self) -> None:
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                connection, _ = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no file is left, or a client that has gone
                if error.errno in OUT_OF_FILES and not self._make_room():
                    self._closed.wait(0.05)
                    return
                continue
            self._current = connection
            connection.setblocking(False)
            evicted = self._waiting.add(connection, self._users.user_of(connection), time.monotonic())
            if evicted is not None:
                self._unregister(evicted)
                evicted.close()
            # With its edge triggered: what has come already and stays unread does not wake this thread again.
            self._poll.register(connection, select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLET)
            self._by_descriptor[connection.fileno()] = connection
            self._look_at(connection)
            self._current = None

    def _make_room(self) -> bool:
        """Free a descriptor: of the connection that has waited longest, else a reserved one."""
        oldest = self._waiting.oldest()
        if oldest is None:
            return self._reserved.give_up_one()
        self._forget(oldest)
        oldest.close()
        return True

    def _forget(self, connection: socket.socket) -> int:
        """Wait for this one no longer; returns its user."""
        self._unregister(connection)
        return self._waiting.remove(connection)

    def _unregister(self, connection: socket.socket) -> None:
        self._poll.unregister(connection)
        del self._by_descriptor[connection.fileno()]

    def _look_at(self, connection: socket.socket) -> None:
        """Look at what has come of a request, and decide when it is complete. It stays unread until then."""
        self._current = connection
        try:
            head = connection.recv(MAX_HEAD_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            head = b""
        if END_OF_HEAD in head:
            user = self._forget(connection)
            if head.startswith(OURS):
                self._answer(connection, head[: head.index(END_OF_HEAD) + len(END_OF_HEAD)])
            else:
                self._hand_on(connection, user)
        elif not head or len(head) == MAX_HEAD_BYTES:
            self._forget(connection)
            connection.close()
        self._current = None

    def _hand_on(self, connection: socket.socket, user: int) -> None:
        """Hand a connection on to the pages' server, if that has not too many."""
        self._pages = {page: its_user for page, its_user in self._pages.items() if page.fileno() != -1}
        why_not = why_no_page(Counter(self._pages.values()), user, self._limits)
        if why_not is not None:
            self._refused("too many connections", why_not)
            _respond(connection, 503, why_not)
            return
        self._pages[connection] = user
        self._handed_on.put(connection)

    # --- the second stop

    def _answer(self, connection: socket.socket, request: bytes) -> None:
        connection.recv(len(request))  # what stays unread would reset the connection, and lose the answer
        why = why_head_refused(request.removesuffix(END_OF_HEAD))
        if why is not None:
            self._refused("another origin", why)
            _respond(connection, 403, why)
        elif self._stop is None:
            _respond(connection, 503, "a recording has nothing to stop")
        elif request.startswith(b"GET "):
            readiness = self._stop.readiness()
            _respond(connection, 200 if readiness.ready else 503, readiness.text)
        else:
            self._ask(connection, self._stop)

    def _ask(self, connection: socket.socket, stop: StopPath) -> None:
        """Stop the robot, and answer when that is done."""
        stopped = stop.request("a page's second stop")
        with self._asking_changed:
            too_many = self._asking >= self._limits.asking
            self._asking += not too_many
        if too_many:
            _respond(connection, 503, "the robot is being stopped; too many ask at once to wait for the result")
        else:
            stopped.add_done_callback(partial(self._answer_stop, connection))

    def _answer_stop(self, connection: socket.socket, stopped: "Future[str]") -> None:
        """In a thread of the stop's."""
        with self._asking_changed:
            self._asking -= 1
        error = stopped.exception()
        if error is None:
            _respond(connection, 200, stopped.result())
        else:
            _respond(connection, 503, str(error) or type(error).__name__)


def _files() -> tuple[int, int]:
    """How many files this process may have open, and how many of these are free."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = 1 << 20 if soft == resource.RLIM_INFINITY else soft
    return allowed, allowed - len(list(Path("/proc/self/fd").iterdir()))


def _respond(connection: socket.socket, status: int, text: str) -> None:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    with contextlib.suppress(OSError), connection:
        connection.send(head.encode() + body)  # far less than a new connection's buffer
        connection.shutdown(socket.SHUT_WR)

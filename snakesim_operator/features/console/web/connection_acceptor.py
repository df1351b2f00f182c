"""Accepts each connection of the console, and answers the requests of the second stop itself.

A stop over `POST /stop` shares nothing with the pages but the port: it has a thread of its own, and needs no websocket,
no viser and no event loop. All other connections are handed on to viser's server unread, once their request is
complete.

No number of connections can prevent a stop. Requests that are not complete are limited in time and in number, in total
and for each user; of too many requests, the oldest one is closed. Connections to the pages are limited in number, too.
If the file table is full all the same, a reserved descriptor is closed to accept the next connection.
"""

import contextlib
import errno
import os
import resource
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Protocol

from snakesim_hal.base.workers import start_worker
from snakesim_operator.base.page_origin import explain_head_refusal
from snakesim_operator.features.console.web.connection_limits import (
    ConnectionLimits,
    PendingRequests,
    choose_limits,
    why_no_page,
)
from snakesim_operator.features.console.web.handoff_listener import HandoffListener
from snakesim_operator.features.console.web.peer_user import PeerUsers

PATH = "/stop"
STOP_REQUESTS = tuple(f"{method} {PATH} ".encode() for method in ("GET", "POST"))  # how their first line begins
END_OF_HEAD = b"\r\n\r\n"
MAX_HEAD_BYTES = 16 * 1024  # of a request; far above what a browser sends
HEAD_LIMIT_S = 10.0  # from the connection to the end of the request's head
BACKLOG = 1024  # connections that the kernel keeps until they are accepted; it may have a lower limit
MAX_ACCEPTED_AT_ONCE = 128  # then the connections that are waiting are read again
RESERVED_DESCRIPTORS = 4
POLL_S = 0.1  # how often old requests are closed, and the stop's self-test is started if it is due
FULL_TABLE_PAUSE_S = 0.05  # before the next attempt to accept, when no descriptor is left
OUT_OF_FILES = (errno.EMFILE, errno.ENFILE)
UNLIMITED_FILES = 1 << 20  # what counts as the limit where there is none
REASONS = {200: "OK", 400: "Bad Request", 403: "Forbidden", 503: "Service Unavailable"}


class Readiness(Protocol):
    """The result of a self-test: whether a stop would reach the robot."""

    @property
    def ready(self) -> bool:
        """Whether a stop would reach the robot."""
        ...

    @property
    def text(self) -> str:
        """The same in words, with the reason if it would not."""
        ...


class StopPath(Protocol):
    """Stops the robot, and tests whether it could. None of its methods waits."""

    def request(self, requester: str) -> "Future[str]":
        """Stop the robot; the future gets the result in words, or an error."""
        ...

    def readiness(self) -> Readiness:
        """Return the result of the newest self-test."""
        ...

    def test_if_due(self) -> None:
        """Start a self-test, if it is time for one."""
        ...


class ReservedDescriptors:
    """Open descriptors without a use, which are closed when the file table is full, and opened again later."""

    def __init__(self, count: int) -> None:
        """Open this many descriptors."""
        self._count = count
        self._descriptors: list[int] = []
        self.refill()

    def refill(self) -> None:
        """Open the descriptors that were given up, as far as the file table has room."""
        with contextlib.suppress(OSError):
            while len(self._descriptors) < self._count:
                self._descriptors.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def give_up_one(self) -> bool:
        """Close one, so that another file can be opened. Return whether there was one."""
        if not self._descriptors:
            return False
        os.close(self._descriptors.pop())
        return True

    def close(self) -> None:
        """Close all of them."""
        while self.give_up_one():
            pass


class ConnectionAcceptor:
    """Accepts connections in a thread of its own, for as long as its context lasts."""

    def __init__(
        self,
        listening: socket.socket,
        handoff: HandoffListener,
        stop: StopPath | None,
        on_refused: Callable[[str, str], None] = lambda _kind, _reason: None,
        limits: ConnectionLimits | None = None,
    ) -> None:
        """Open what is needed, but accept nothing yet.

        Args:
            listening: Where browsers connect.
            handoff: Gets the connections that are not for the second stop.
            stop: Stops the robot; None for a recording, where there is nothing to stop.
            on_refused: Called with a kind and a reason for each connection that is refused.
            limits: None: chosen by the number of files that this process may open.
        """
        self._listening = listening
        self._handoff = handoff
        self._stop = stop
        self._on_refused = on_refused
        self._limits = choose_limits(*_count_files()) if limits is None else limits
        # Connections. Those of `_pending` wait for the end of their request.
        self._pending: PendingRequests[socket.socket] = PendingRequests(self._limits)
        self._by_descriptor: dict[int, socket.socket] = {}  # the same
        self._page_users: dict[socket.socket, int] = {}  # user of each connection that was handed off
        self._current: socket.socket | None = None  # the one that this thread works on
        # Requests that wait for the result of a stop. A thread of the stop answers them, so a lock guards their number.
        self._waiting_for_stop = 0
        self._waiting_for_stop_lock = threading.Lock()
        # Opened in advance, because a stop must not depend on what can be opened later.
        self._peer_users = PeerUsers()
        self._reserved = ReservedDescriptors(RESERVED_DESCRIPTORS)
        self._poll = select.epoll()
        # The thread.
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> "ConnectionAcceptor":
        self._listening.setblocking(False)
        self._listening.listen(BACKLOG)
        self._poll.register(self._listening, select.EPOLLIN)
        self._thread = start_worker("front", self._serve, is_over=self._closed.is_set, on_error=self._close_current)
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        assert self._thread is not None
        self._thread.join()
        for connection in self._pending.list_all():
            connection.close()
        self._poll.close()
        self._peer_users.close()
        self._reserved.close()
        self._listening.close()

    def _serve(self) -> None:
        """Serve until the context ends. After an unexpected error, `start_worker` calls this again."""
        while not self._closed.is_set():
            for descriptor, _ in self._poll.poll(POLL_S):
                if descriptor == self._listening.fileno():
                    self._accept_connections()
                elif descriptor in self._by_descriptor:
                    self._read_request(self._by_descriptor[descriptor])
            for connection in self._pending.list_older_than(time.monotonic() - HEAD_LIMIT_S):
                self._forget_pending(connection)
                connection.close()
            self._reserved.refill()
            if self._stop is not None:
                self._stop.test_if_due()

    def _close_current(self, _error: Exception) -> None:
        """Close the connection at which an unexpected error was raised."""
        connection = self._current
        self._current = None
        if connection is None:
            return
        if connection in self._pending:
            self._forget_pending(connection)
        connection.close()

    # --- connections -----------------------------------------------------------------------------------------

    def _accept_connections(self) -> None:
        """Accept the connections that are waiting in the kernel, up to a number."""
        for _ in range(MAX_ACCEPTED_AT_ONCE):
            try:
                connection, _ = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no descriptor is left, or the client has gone
                if error.errno in OUT_OF_FILES and not self._free_descriptor():
                    self._closed.wait(FULL_TABLE_PAUSE_S)
                    return
                continue
            self._current = connection
            self._add_pending(connection)
            self._read_request(connection)
            self._current = None

    def _add_pending(self, connection: socket.socket) -> None:
        """Wait for the request of a new connection; close another one if there are too many."""
        connection.setblocking(False)
        user = self._peer_users.user_of(connection)
        evicted = self._pending.add(connection, user, time.monotonic())
        if evicted is not None:
            self._unregister(evicted)
            evicted.close()
        # Triggered by edges, so that the part of a request that stays unread does not wake this thread again.
        self._poll.register(connection, select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLET)
        self._by_descriptor[connection.fileno()] = connection

    def _free_descriptor(self) -> bool:
        """Close the connection that has waited longest, else a reserved descriptor. Return whether there was one."""
        oldest = self._pending.oldest()
        if oldest is None:
            return self._reserved.give_up_one()
        self._forget_pending(oldest)
        oldest.close()
        return True

    def _forget_pending(self, connection: socket.socket) -> int:
        """Stop waiting for the request of a connection, and return its user."""
        self._unregister(connection)
        return self._pending.remove(connection)

    def _unregister(self, connection: socket.socket) -> None:
        self._poll.unregister(connection)
        del self._by_descriptor[connection.fileno()]

    def _read_request(self, connection: socket.socket) -> None:
        """Read what has arrived of a request, and answer the request or hand it off once its head is complete.

        It is only peeked at, so that the server of the pages can read it from its beginning.
        """
        self._current = connection
        try:
            head = connection.recv(MAX_HEAD_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            return
        except OSError:
            head = b""
        if END_OF_HEAD in head:
            user = self._forget_pending(connection)
            if head.startswith(STOP_REQUESTS):
                length = head.index(END_OF_HEAD) + len(END_OF_HEAD)
                self._answer_stop_request(connection, head[:length])
            else:
                self._hand_off(connection, user)
        elif not head or len(head) == MAX_HEAD_BYTES:  # the client has gone, or the head is too long
            self._forget_pending(connection)
            connection.close()
        self._current = None

    def _hand_off(self, connection: socket.socket, user: int) -> None:
        """Hand a connection off to the server of the pages, unless that has too many."""
        self._page_users = {page: page_user for page, page_user in self._page_users.items() if page.fileno() != -1}
        refusal = why_no_page(Counter(self._page_users.values()), user, self._limits)
        if refusal is not None:
            self._on_refused("too many connections", refusal)
            _respond(connection, 503, refusal)
            return
        self._page_users[connection] = user
        self._handoff.hand_off(connection)

    # --- the second stop -------------------------------------------------------------------------------------

    def _answer_stop_request(self, connection: socket.socket, request: bytes) -> None:
        """Answer `GET /stop` with the readiness of the stop, and `POST /stop` by stopping the robot."""
        connection.recv(len(request))  # unread bytes would reset the connection, and the answer would be lost
        refusal = explain_head_refusal(request.removesuffix(END_OF_HEAD))
        if refusal is not None:
            self._on_refused("another origin", refusal)
            _respond(connection, 403, refusal)
        elif self._stop is None:
            _respond(connection, 503, "a recording has nothing to stop")
        elif request.startswith(b"GET "):
            readiness = self._stop.readiness()
            _respond(connection, 200 if readiness.ready else 503, readiness.text)
        else:
            self._stop_robot(connection, self._stop)

    def _stop_robot(self, connection: socket.socket, stop: StopPath) -> None:
        """Stop the robot, and answer when that is done.

        The stop is requested before its requesters are counted: their number limits only the answers.
        """
        stopped = stop.request("a page's second stop")
        with self._waiting_for_stop_lock:
            may_wait = self._waiting_for_stop < self._limits.asking
            if may_wait:
                self._waiting_for_stop += 1
        if may_wait:
            stopped.add_done_callback(partial(self._answer_stop_result, connection))
        else:
            _respond(connection, 503, "the robot is being stopped; too many ask at once to wait for the result")

    def _answer_stop_result(self, connection: socket.socket, stopped: "Future[str]") -> None:
        """Answer with the result of a stop; called by a thread of the stop."""
        with self._waiting_for_stop_lock:
            self._waiting_for_stop -= 1
        error = stopped.exception()
        if error is None:
            _respond(connection, 200, stopped.result())
        else:
            _respond(connection, 503, str(error) or type(error).__name__)


def _count_files() -> tuple[int, int]:
    """Return how many files this process may have open, and how many of these are free."""
    soft_limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    max_files = UNLIMITED_FILES if soft_limit == resource.RLIM_INFINITY else soft_limit
    open_files = len(list(Path("/proc/self/fd").iterdir()))
    return max_files, max_files - open_files


def _respond(connection: socket.socket, status: int, text: str) -> None:
    """Answer a request, and close its connection. Does not wait."""
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    with contextlib.suppress(OSError), connection:
        connection.send(head.encode() + body)  # far less than a new connection's buffer takes
        connection.shutdown(socket.SHUT_WR)

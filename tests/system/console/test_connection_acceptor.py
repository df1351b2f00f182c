"""In front of the pages: no number of connections, and no error, keeps a stop from being asked for and answered."""

import contextlib
import errno
import http.client
import os
import socket
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

import pytest

from snakesim_operator.base.console_port import open_port
from snakesim_operator.features.console.web.connection_acceptor import ConnectionAcceptor
from snakesim_operator.features.console.web.connection_limits import (
    ConnectionLimits,
    PendingRequests,
    choose_limits,
    why_no_page,
)
from snakesim_operator.features.console.web.handoff_listener import HandoffListener
from snakesim_operator.features.console.web.peer_user import PeerUsers
from snakesim_operator.robot_commands.prepared_stop import StopReadiness
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.ready_stop import ReadyStop

FEW = ConnectionLimits(waiting=4, waiting_of_user=4, pages=2, pages_of_user=2, asking=2)
COMPLETE = b"GET /index.html HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
HALF = (b"", b"GET / HTTP/1.1\r\nHost: ", b"POST /stop HTTP/1.1\r\n")


class Door:
    """A front without pages behind it."""

    def __init__(self, front: ConnectionAcceptor, listening: socket.socket, handed_on: HandoffListener) -> None:
        self.front, self.handed_on = front, handed_on
        self.address: tuple[str, int] = listening.getsockname()

    def send(self, request: bytes) -> socket.socket:
        """Open a connection, and send a request or a part of one."""
        connection = socket.create_connection(self.address, timeout=5.0)
        connection.sendall(request)
        return connection

    def ask(self, method: str) -> tuple[int, str]:
        """Status and text of the second stop's answer."""
        connection = http.client.HTTPConnection(*self.address, timeout=5.0)
        with contextlib.closing(connection):
            connection.request(method, "/stop")
            answer = connection.getresponse()
            return answer.status, answer.read().decode()


@contextmanager
def door(stop: ReadyStop, limits: ConnectionLimits = FEW) -> Iterator[Door]:
    listening = open_port(None)
    handed_on = HandoffListener(listening.getsockname())
    handed_on.setblocking(False)  # as asyncio does
    with contextlib.closing(handed_on), ConnectionAcceptor(listening, handed_on, stop, limits=limits) as front:
        yield Door(front, listening, handed_on)


def is_closed(connection: socket.socket) -> bool:
    """Whether the other end has closed it, without an answer."""
    connection.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        try:
            return connection.recv(1000) == b""
        except ConnectionResetError:
            return True
    return False


def test_acceptor_closes_oldest_incomplete_request_and_answers_a_stop() -> None:
    stop = ReadyStop()
    with door(stop) as at, contextlib.ExitStack() as stack:
        opened = [stack.enter_context(at.send(HALF[number % len(HALF)])) for number in range(3 * FEW.waiting)]
        wait_until(lambda: sum(map(is_closed, opened)) == 2 * FEW.waiting, "the oldest ones closed", 5.0)
        assert not is_closed(opened[-1])
        assert at.ask("POST") == (200, "stopped")
        assert stop.requesters == ["a page's second stop"]
        assert at.ask("GET") == (200, "ready")


def test_acceptor_forwards_only_complete_requests_up_to_limit() -> None:
    with door(ReadyStop()) as at, contextlib.ExitStack() as stack:
        first = stack.enter_context(at.send(COMPLETE[:20]))
        with pytest.raises(BlockingIOError):
            at.handed_on.accept()
        first.sendall(COMPLETE[20:])
        for _ in range(FEW.pages - 1):
            stack.enter_context(at.send(COMPLETE))
        served: list[socket.socket] = []

        def accept() -> bool:
            with contextlib.suppress(BlockingIOError):
                served.append(stack.enter_context(at.handed_on.accept()[0]))
            return len(served) == FEW.pages

        wait_until(accept, "the pages", 5.0)
        assert served[0].recv(1000) == COMPLETE
        refused = stack.enter_context(at.send(COMPLETE))
        assert refused.recv(1000).startswith(b"HTTP/1.1 503")
        assert at.ask("GET") == (200, "ready")
        served.pop().close()
        stack.enter_context(at.send(COMPLETE))
        wait_until(accept, "a page in the place of one that was closed", 5.0)


class FullTable(socket.socket):
    """Listens in a process whose file table is full, until a file is closed."""

    fails = 0

    def accept(self) -> tuple[socket.socket, object]:
        if FullTable.fails:
            FullTable.fails -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return super().accept()


def test_acceptor_with_full_file_table_still_answers_a_stop() -> None:
    stop = ReadyStop()
    listening = FullTable(fileno=open_port(None).detach())
    handed_on = HandoffListener(listening.getsockname())
    with contextlib.closing(handed_on), ConnectionAcceptor(listening, handed_on, stop, limits=FEW) as front:
        at = Door(front, listening, handed_on)
        FullTable.fails = 2
        assert at.ask("POST") == (200, "stopped")
        with at.send(HALF[1]) as oldest:
            wait_until(lambda: len(front._pending) == 1, "a request that waits", 5.0)
            FullTable.fails = 1
            assert at.ask("POST") == (200, "stopped")
            wait_until(lambda: is_closed(oldest), "the end of the one that waited", 5.0)


class BrokenStop(ReadyStop):
    """Fails once in each of its ways, with an error that nobody expected."""

    def __init__(self) -> None:
        super().__init__()
        self.errors: list[Exception] = [OSError(errno.EMFILE, "Too many open files"), KeyError("uid")]

    def request(self, requester: str) -> "Future[str]":
        if not self.errors:
            return super().request(requester)
        error = self.errors.pop(0)
        if isinstance(error, KeyError):
            raise error
        stopped: Future[str] = Future()
        stopped.set_exception(error)
        return stopped


def test_acceptor_answers_failed_stop_with_error_and_takes_next() -> None:
    with door(BrokenStop()) as at:
        assert at.ask("POST") == (503, "[Errno 24] Too many open files")
        with pytest.raises((http.client.RemoteDisconnected, ConnectionResetError)):
            at.ask("POST")  # the thread that serves goes on
        assert at.ask("POST") == (200, "stopped")


class UnreadyStop(ReadyStop):
    """Its self-test fails."""

    def readiness(self) -> StopReadiness:
        return StopReadiness(ready=False, text="the robot's host does not answer")


def test_ready_is_what_the_self_test_says() -> None:
    with door(UnreadyStop()) as at:
        assert at.ask("GET") == (503, "the robot's host does not answer")


def test_acceptor_limits_each_user_to_leave_room_for_others() -> None:
    limits = ConnectionLimits(waiting=6, waiting_of_user=4)
    waiting: PendingRequests[str] = PendingRequests(limits)
    assert [waiting.add(f"flood {number}", 1, number) for number in range(6)] == 4 * [None] + ["flood 0", "flood 1"]
    assert [waiting.add(name, 2, 10.0) for name in ("a", "b")] == [None, None]
    assert waiting.add("c", 2, 11.0) == "flood 2", "of the user who has most"
    assert waiting.list_older_than(5.0) == ["flood 3", "flood 4"]
    assert waiting.oldest(2) == "a"
    assert waiting.remove("a") == 2
    assert len(waiting) == 5


def test_pages_are_limited_in_all_and_for_each_user() -> None:
    limits = ConnectionLimits(pages=4, pages_of_user=3)
    assert why_no_page(Counter({1: 2}), 1, limits) is None
    assert why_no_page(Counter({1: 3}), 1, limits) == "more than 3 connections of one user are open; close some pages"
    assert why_no_page(Counter({1: 3}), 2, limits) is None
    assert "more than 4 connections are open" in (why_no_page(Counter({1: 3, 2: 1}), 3, limits) or "")


@pytest.mark.parametrize("files", [128, 256, 1024, 20_000])
def test_limits_leave_files_for_everything_else(files: int) -> None:
    limits = choose_limits(files, files - 40)
    taken = limits.waiting + limits.pages + limits.asking
    assert taken <= max(files - 40 - 64, files // 8)
    assert limits.waiting_of_user < limits.waiting
    assert limits == ConnectionLimits() or files < 1024


def test_the_kernel_says_whose_connection_it_is() -> None:
    users = PeerUsers()
    with open_port(None) as listening, socket.create_connection(listening.getsockname()) as connection:
        accepted, _ = listening.accept()
        with accepted:
            assert users.user_of(accepted) == os.getuid()
            connection.close()
    users.close()

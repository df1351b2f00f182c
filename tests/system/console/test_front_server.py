"""In front of the pages: no number of connections, and no error, keeps a stop from being asked for and answered."""

import contextlib
import errno
import http.client
import socket
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager

import pytest

from snakesim_operator.base.console_port import ConsolePorts, open_console_ports
from snakesim_operator.features.console.front import front_server
from snakesim_operator.features.console.front.front_server import REQUESTER, FrontServer
from snakesim_operator.features.console.front.requests import (
    BadRequest,
    FrontRequest,
    parse_and_authorize_head,
)
from snakesim_operator.robot_commands.prepared_stop import StopReadiness
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.operator.ready_stop import ReadyStop
from snakesim_testing.operator.served_console import running_front_server

FEW = 4
HALF = (b"", b"GET / HTTP/1.1\r\nHost: ", b"POST /stop HTTP/1.1\r\n")


class Client:
    """A client of a front server without pages behind it."""

    def __init__(self, ports: ConsolePorts, server: FrontServer) -> None:
        self.ports = ports
        self.server = server
        self.address: tuple[str, int] = ports.browser_socket.getsockname()

    def send(self, request: bytes) -> socket.socket:
        """Open a connection, and send a request or a part of one."""
        connection = socket.create_connection(self.address, timeout=5.0)
        connection.sendall(request)
        return connection

    def connect(self) -> http.client.HTTPConnection:
        """Open a connection for requests."""
        return http.client.HTTPConnection(*self.address, timeout=5.0)

    def ask(self, method: str) -> tuple[int, str]:
        """Return status and text of the second stop's answer."""
        with contextlib.closing(self.connect()) as connection:
            return self.ask_over(connection, method)

    def ask_over(self, connection: http.client.HTTPConnection, method: str) -> tuple[int, str]:
        """Ask over a connection that is open."""
        connection.request(method, f"/{self.ports.token}/stop")
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


@contextmanager
def front(stop: ReadyStop | None) -> Iterator[Client]:
    with open_console_ports(None) as ports, running_front_server(ports, stop) as server:
        yield Client(ports, server)


def is_closed(connection: socket.socket) -> bool:
    """Return whether the other end has closed it, without an answer."""
    connection.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        try:
            return connection.recv(1000) == b""
        except ConnectionResetError:
            return True
    return False


def test_of_too_many_incomplete_requests_the_oldest_is_closed_and_a_stop_is_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_WAITING", FEW)
    stop = ReadyStop()
    with (
        front(stop) as client,
        contextlib.ExitStack() as stack,
        contextlib.closing(client.connect()) as kept,
    ):
        assert client.ask_over(kept, "GET") == (200, "ready")
        opened = [
            stack.enter_context(client.send(HALF[number % len(HALF)])) for number in range(3 * FEW)
        ]
        wait_until(lambda: sum(map(is_closed, opened)) == 2 * FEW, "the oldest ones closed", 5.0)
        assert not is_closed(opened[-1])
        assert client.ask("POST") == (200, "stopped") and stop.requesters == [REQUESTER]
        used = kept.sock
        assert client.ask_over(kept, "POST") == (200, "stopped") and kept.sock is used, (
            "a page's connection is kept"
        )


def test_of_too_many_stops_all_are_carried_out_and_some_are_not_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_AT_STOP", 1)
    stop = ReadyStop()
    with front(stop) as client, contextlib.closing(client.connect()) as kept:
        assert client.ask_over(kept, "POST") == (200, "stopped")
        status, text = client.ask("POST")
        assert status == 503 and "is being stopped" in text and len(stop.requesters) == 2
        assert client.ask("GET") == (200, "ready")


def test_pages_are_limited_and_get_the_request_without_the_token(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_PAGES", 1)
    with front(None) as client:
        request = (
            f"GET /{client.ports.token}/signals?a=/b HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        )
        with client.send(request) as first:
            pages, _ = client.ports.page_socket.accept()
            with pages:
                assert pages.recv(1000) == b"GET /signals?a=/b HTTP/1.1\r\nHost: localhost\r\n\r\n"
                pages.sendall(b"answer")
                assert first.recv(6) == b"answer"
                with client.send(request) as refused:
                    assert refused.recv(1000).startswith(b"HTTP/1.1 503")
            wait_until(lambda: is_closed(first), "the end that the page server made", 5.0)
        with client.send(request):
            pages, _ = client.ports.page_socket.accept()
            pages.close()


def test_without_pages_there_is_an_answer() -> None:
    with front(ReadyStop()) as client:
        client.ports.page_socket.close()
        with client.send(
            f"GET /{client.ports.token}/ HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        ) as page:
            assert b"503" in page.recv(1000)
        assert client.ask("POST") == (200, "stopped")


class BrokenStop(ReadyStop):
    """Fails once in each of its ways, with an error that was not expected."""

    def __init__(self) -> None:
        super().__init__()
        self.errors: list[Exception] = [
            OSError(errno.EMFILE, "Too many open files"),
            KeyError("uid"),
        ]

    def request_stop(self, requester: str) -> "Future[str]":
        if not self.errors:
            return super().request_stop(requester)
        error = self.errors.pop(0)
        if isinstance(error, KeyError):
            raise error
        stopped: Future[str] = Future()
        stopped.set_exception(error)
        return stopped


def test_an_error_of_a_stop_is_its_answer_and_the_next_stop_is_carried_out() -> None:
    with front(BrokenStop()) as client:
        assert client.ask("POST") == (503, "[Errno 24] Too many open files")
        with pytest.raises((http.client.RemoteDisconnected, ConnectionResetError)):
            client.ask("POST")
        assert client.ask("POST") == (200, "stopped")


class UnreadyStop(ReadyStop):
    """Its self-test fails."""

    def check_readiness(self) -> StopReadiness:
        return StopReadiness(is_ready=False, text="the robot's host does not answer")


def test_ready_is_what_the_self_test_reports() -> None:
    with front(UnreadyStop()) as client:
        assert client.ask("GET") == (503, "the robot's host does not answer")


def check(first_line: str, *headers: str) -> FrontRequest | BadRequest:
    """Check a request to a console with the token `secret`."""
    return parse_and_authorize_head("\r\n".join([first_line, *headers, "", ""]).encode(), "secret")


@pytest.mark.parametrize(
    ("target", "path", "passed_on"),
    [
        ("/secret/", "/", "/"),
        ("/secret", "", "/"),
        ("/secret?a=b", "", "/?a=b"),
        ("/secret/signals/values?name=a/b", "/signals/values", "/signals/values?name=a/b"),
    ],
)
def test_the_token_is_removed(target: str, path: str, passed_on: str) -> None:
    request = check(f"GET {target} HTTP/1.1", "Host: localhost:8080", "upgrade: websocket")
    assert isinstance(request, FrontRequest) and request.path == path and request.is_websocket
    assert (
        request.head
        == f"GET {passed_on} HTTP/1.1\r\nHost: localhost:8080\r\nupgrade: websocket\r\n\r\n".encode()
    )


@pytest.mark.parametrize(
    "target", ["/", "/secre/", "/secrets/", "secret", "//secret/", "/%73ecret/", "/?secret", "*"]
)
def test_another_token_is_refused(target: str) -> None:
    request = check(f"GET {target} HTTP/1.1", "Host: localhost:8080")
    assert isinstance(request, BadRequest) and (request.status, request.kind) == (
        403,
        "wrong token",
    )


def test_another_origin_is_refused_with_the_token_too() -> None:
    for headers in (
        ("Host: evil.example",),
        ("Host: localhost:1", "Origin: http://localhost:2"),
        (),
    ):
        request = check("GET /secret/ HTTP/1.1", *headers)
        assert isinstance(request, BadRequest) and (request.status, request.kind) == (
            403,
            "another origin",
        )
    assert isinstance(check("nonsense", "Host: localhost"), BadRequest)

"""The front server of the console answers every stop, whatever number of connections or errors there is."""

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

MAX_WAITING = 4  # incomplete requests that the server keeps in these tests
INCOMPLETE_REQUESTS = (b"", b"GET / HTTP/1.1\r\nHost: ", b"POST /stop HTTP/1.1\r\n")


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

    def request_stop_page(self, method: str) -> tuple[int, str]:
        """Request the second stop over a new connection, and return status and text of the answer.

        Args:
            method: `POST` stops the robot, `GET` returns whether the stop is ready.
        """
        with contextlib.closing(self.connect()) as connection:
            return self.request_stop_page_over(connection, method)

    def request_stop_page_over(
        self, connection: http.client.HTTPConnection, method: str
    ) -> tuple[int, str]:
        """Request the second stop over an open connection."""
        connection.request(method, f"/{self.ports.token}/stop")
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


@contextmanager
def running_client(stop: ReadyStop | None) -> Iterator[Client]:
    """Run a front server with a stop, and yield its client."""
    with open_console_ports(None) as ports, running_front_server(ports, stop) as server:
        yield Client(ports, server)


def is_closed(connection: socket.socket) -> bool:
    """Return whether the server has closed a connection without an answer."""
    connection.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        try:
            return connection.recv(1000) == b""
        except ConnectionResetError:
            return True
    return False


def test_front_server_with_many_incomplete_requests_still_answers_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_WAITING", MAX_WAITING)
    stop = ReadyStop()
    with (
        running_client(stop) as client,
        contextlib.ExitStack() as stack,
        contextlib.closing(client.connect()) as kept_connection,
    ):
        assert client.request_stop_page_over(kept_connection, "GET") == (200, "ready")
        opened = [
            stack.enter_context(client.send(INCOMPLETE_REQUESTS[number % len(INCOMPLETE_REQUESTS)]))
            for number in range(3 * MAX_WAITING)
        ]
        wait_until(
            lambda: sum(map(is_closed, opened)) == 2 * MAX_WAITING,
            "the oldest connections closed",
            5.0,
        )
        assert not is_closed(opened[-1])
        assert client.request_stop_page("POST") == (200, "stopped")
        assert stop.requesters == [REQUESTER]
        socket_before = kept_connection.sock
        assert client.request_stop_page_over(kept_connection, "POST") == (200, "stopped")
        assert kept_connection.sock is socket_before, "the connection of a page was closed"


def test_front_server_with_many_stops_requests_every_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_AT_STOP", 1)
    stop = ReadyStop()
    with running_client(stop) as client, contextlib.closing(client.connect()) as kept_connection:
        assert client.request_stop_page_over(kept_connection, "POST") == (200, "stopped")
        status, text = client.request_stop_page("POST")
        assert status == 503
        assert "is being stopped" in text
        assert len(stop.requesters) == 2
        assert client.request_stop_page("GET") == (200, "ready")


def test_front_server_limits_pages_and_removes_their_token(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(front_server, "MAX_PAGES", 1)
    with running_client(None) as client:
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
            wait_until(lambda: is_closed(first), "the connection that the page server closed", 5.0)
        with client.send(request):
            pages, _ = client.ports.page_socket.accept()
            pages.close()


def test_front_server_without_page_server_answers_pages_and_stop() -> None:
    with running_client(ReadyStop()) as client:
        client.ports.page_socket.close()
        with client.send(
            f"GET /{client.ports.token}/ HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        ) as page:
            assert b"503" in page.recv(1000)
        assert client.request_stop_page("POST") == (200, "stopped")


class BrokenStop(ReadyStop):
    """A stop that fails twice, once in its result and once when it is requested, and then works."""

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


def test_front_server_after_failed_stop_carries_out_the_next() -> None:
    with running_client(BrokenStop()) as client:
        assert client.request_stop_page("POST") == (503, "[Errno 24] Too many open files")
        with pytest.raises((http.client.RemoteDisconnected, ConnectionResetError)):
            client.request_stop_page("POST")
        assert client.request_stop_page("POST") == (200, "stopped")


class UnreadyStop(ReadyStop):
    """A stop whose self-test fails."""

    def check_readiness(self) -> StopReadiness:
        return StopReadiness(is_ready=False, text="the robot's host does not answer")


def test_front_server_readiness_is_result_of_stop_self_test() -> None:
    with running_client(UnreadyStop()) as client:
        assert client.request_stop_page("GET") == (503, "the robot's host does not answer")


def parse_request(first_line: str, *headers: str) -> FrontRequest | BadRequest:
    """Parse and authorize a request to a console with the token `secret`."""
    return parse_and_authorize_head("\r\n".join([first_line, *headers, "", ""]).encode(), "secret")


@pytest.mark.parametrize(
    ("target", "path", "forwarded"),
    [
        ("/secret/", "/", "/"),
        ("/secret", "", "/"),
        ("/secret?a=b", "", "/?a=b"),
        ("/secret/signals/values?name=a/b", "/signals/values", "/signals/values?name=a/b"),
    ],
)
def test_front_request_is_forwarded_without_token(target: str, path: str, forwarded: str) -> None:
    request = parse_request(f"GET {target} HTTP/1.1", "Host: localhost:8080", "upgrade: websocket")
    assert isinstance(request, FrontRequest)
    assert request.path == path
    assert request.is_websocket
    forwarded_head = (
        f"GET {forwarded} HTTP/1.1\r\nHost: localhost:8080\r\nupgrade: websocket\r\n\r\n"
    )
    assert request.head == forwarded_head.encode()


@pytest.mark.parametrize(
    "target", ["/", "/secre/", "/secrets/", "secret", "//secret/", "/%73ecret/", "/?secret", "*"]
)
def test_front_request_with_wrong_token_is_refused(target: str) -> None:
    request = parse_request(f"GET {target} HTTP/1.1", "Host: localhost:8080")
    assert isinstance(request, BadRequest)
    assert (request.status, request.kind) == (403, "wrong token")


def test_front_request_from_another_origin_is_refused_despite_token() -> None:
    for headers in (
        ("Host: evil.example",),
        ("Host: localhost:1", "Origin: http://localhost:2"),
        (),
    ):
        request = parse_request("GET /secret/ HTTP/1.1", *headers)
        assert isinstance(request, BadRequest)
        assert (request.status, request.kind) == (403, "another origin")
    assert isinstance(parse_request("nonsense", "Host: localhost"), BadRequest)

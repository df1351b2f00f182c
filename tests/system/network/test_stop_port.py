"""The stop port obeys and answers every valid stop request, whatever else other programs send to it."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.stop_port import (
    ANSWER_HEADER,
    REQUEST_HEADER,
    Reply,
    find_stop_address,
    open_stop_port,
    request_stop,
    start_stop_server,
)
from snakesim_testing.messages import raises_error

LOOPBACK = "127.0.0.1"


@contextmanager
def running_stop_server() -> Iterator[tuple[int, list[str]]]:
    """Run a stop server that answers `done`; yield its port and the names of the requesters so far."""
    requesters: list[str] = []

    def on_stop_request(requester: str, reply: Reply) -> None:
        requesters.append(requester)
        reply("done")

    with open_stop_port(LOOPBACK, 0) as server_socket:
        start_stop_server(server_socket, "lab/worm", on_stop_request)
        yield server_socket.getsockname()[1], requesters


def test_stop_port_obeys_request_and_answers_with_robot_name() -> None:
    with running_stop_server() as (port, requesters):
        answer = request_stop(LOOPBACK, port, "anna", 5.0)
        assert answer is not None
        assert answer.robot == "lab/worm"
        assert answer.text == "done"
        assert requesters == ["anna"]


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"x",
        REQUEST_HEADER[:4],
        REQUEST_HEADER,
        REQUEST_HEADER + b"short",
        b"SNAKSTOQ" + bytes(16),
        bytes(60_000),
    ],
)
def test_stop_port_ignores_datagrams_that_are_no_request(datagram: bytes) -> None:
    with (
        running_stop_server() as (port, requesters),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        client.sendto(datagram, (LOOPBACK, port))
        assert request_stop(LOOPBACK, port, "anna", 5.0) is not None
        assert requesters == ["anna"]


def test_stop_port_shortens_long_requester_and_obeys() -> None:
    with (
        running_stop_server() as (port, requesters),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        client.sendto(REQUEST_HEADER + bytes(16) + b"a" * 5000, (LOOPBACK, port))
        client.settimeout(5.0)
        assert client.recv(2048).startswith(ANSWER_HEADER + bytes(16))
        assert requesters == ["a" * 64]


def test_request_stop_ignores_answers_of_other_senders_and_requests() -> None:
    with (
        open_stop_port(LOOPBACK, 0) as server_socket,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_socket,
    ):
        port = server_socket.getsockname()[1]
        answers: list[object] = []
        requesting = threading.Thread(
            target=lambda: answers.append(request_stop(LOOPBACK, port, "anna", 0.5))
        )
        requesting.start()
        request, client_address = server_socket.recvfrom(200)
        request_id = request[8:24]
        wrong_id = bytes(16)
        answer_text = b"lab/worm\ndone"
        other_socket.sendto(ANSWER_HEADER + request_id + answer_text, client_address)
        server_socket.sendto(ANSWER_HEADER + wrong_id + answer_text, client_address)
        requesting.join()
        assert answers == [None]


def test_stop_port_in_use_or_closed_raises_error() -> None:
    with open_stop_port(LOOPBACK, 0) as server_socket:
        port = server_socket.getsockname()[1]
        with raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"):
            open_stop_port(LOOPBACK, port)
    with raises_error(NotConnectedError, code="network/no-answer"):
        request_stop(LOOPBACK, port, "anna", 5.0)


@pytest.mark.parametrize(
    ("endpoint", "listens", "stop_address"),
    [
        ("tcp/127.0.0.1:7447", True, ("127.0.0.1", 7447)),
        ("tcp/[::1]:7447", True, ("::1", 7447)),
        ("tls/robot.lab:7448?x=1", True, ("robot.lab", 7448)),
        ("tcp/10.0.0.1:7447", False, ("127.0.0.1", 0)),  # the router has this port
        ("udp/127.0.0.1:7447", True, ("127.0.0.1", 0)),  # Zenoh has that port itself
    ],
)
def test_find_stop_address_returns_endpoint_of_listening_tcp_host(
    endpoint: str, listens: bool, stop_address: tuple[str, int]
) -> None:
    assert find_stop_address(endpoint, listens=listens) == stop_address

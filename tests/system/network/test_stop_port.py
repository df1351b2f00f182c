"""The stop port: what is a stop comes through, whatever else is sent."""

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
def served() -> Iterator[tuple[int, list[str]]]:
    """A port that answers, and who asked."""
    asked: list[str] = []

    def take(who: str, reply: Reply) -> None:
        asked.append(who)
        reply("done")

    with open_stop_port(LOOPBACK, 0) as opened:
        start_stop_server(opened, "lab/worm", take)
        yield opened.getsockname()[1], asked


def test_a_stop_is_taken_and_answered_in_the_robots_name() -> None:
    with served() as (port, asked):
        answer = request_stop(LOOPBACK, port, "anna", 5.0)
        assert answer is not None
        assert answer.robot == "lab/worm"
        assert answer.text == "done"
        assert asked == ["anna"]


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
def test_what_is_no_stop_is_not_taken(datagram: bytes) -> None:
    with served() as (port, asked), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(datagram, (LOOPBACK, port))
        assert request_stop(LOOPBACK, port, "anna", 5.0) is not None
        assert asked == ["anna"]


def test_a_stop_that_is_too_long_is_a_stop() -> None:
    with served() as (port, asked), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as long_winded:
        long_winded.sendto(REQUEST_HEADER + bytes(16) + b"a" * 5000, (LOOPBACK, port))
        long_winded.settimeout(5.0)
        assert long_winded.recv(2048).startswith(ANSWER_HEADER + bytes(16))
        assert asked == ["a" * 64]


def test_stop_port_ignores_answers_from_elsewhere() -> None:
    with (
        open_stop_port(LOOPBACK, 0) as silent,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as liar,
    ):
        port = silent.getsockname()[1]
        answers: list[object] = []
        asking = threading.Thread(
            target=lambda: answers.append(request_stop(LOOPBACK, port, "anna", 0.5))
        )
        asking.start()
        request, sender = silent.recvfrom(200)
        liar.sendto(ANSWER_HEADER + request[8:24] + b"lab/worm\ndone", sender)
        silent.sendto(ANSWER_HEADER + bytes(16) + b"lab/worm\ndone", sender)
        asking.join()
        assert answers == [None]


def test_nobody_has_the_port() -> None:
    with open_stop_port(LOOPBACK, 0) as opened:
        port = opened.getsockname()[1]
        with raises_error(NotConnectedError, code="network/port-in-use", field="--endpoint"):
            open_stop_port(LOOPBACK, port)
    with raises_error(NotConnectedError, code="network/no-answer"):
        request_stop(LOOPBACK, port, "anna", 5.0)


@pytest.mark.parametrize(
    ("endpoint", "listens", "address"),
    [
        ("tcp/127.0.0.1:7447", True, ("127.0.0.1", 7447)),
        ("tcp/[::1]:7447", True, ("::1", 7447)),
        ("tls/robot.lab:7448?x=1", True, ("robot.lab", 7448)),
        ("tcp/10.0.0.1:7447", False, ("127.0.0.1", 0)),  # the router's, not ours
        ("udp/127.0.0.1:7447", True, ("127.0.0.1", 0)),  # Zenoh has that port itself
    ],
)
def test_where_it_belongs(endpoint: str, listens: bool, address: tuple[str, int]) -> None:
    assert find_stop_address(endpoint, listens=listens) == address

"""Sends and imitates the UDP datagrams that stop a robot.

A robot has the stop port at the address of its TCP endpoint. A request is `SNAKSTOP`, a nonce of 16 bytes, and the name
of the requester. The answer is `SNAKDONE`, the same nonce, and a text.
"""

import contextlib
import os
import random
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

from verification.attack.command import parse_endpoint
from verification.attack.tools.repetition import repeat_in_background

REQUEST_MARK = b"SNAKSTOP"
ANSWER_MARK = b"SNAKDONE"
NONCE_BYTES = 16
NONCE_SLICE = slice(len(REQUEST_MARK), len(REQUEST_MARK) + NONCE_BYTES)
MAX_DATAGRAM_BYTES = 65536
RESEND_PERIOD_S = 0.05  # a datagram may be lost
REFUSED_PAUSE_S = 0.01  # a refused datagram returns at once


def make_stop_datagram(requester: str | bytes = "operator", nonce: bytes | None = None) -> bytes:
    """Return a datagram that stops the robot.

    Args:
        requester: Name of the requester; bytes may be invalid text.
        nonce: NONCE_BYTES bytes that the answer repeats; None for random ones.
    """
    if isinstance(requester, str):
        requester = requester.encode()
    if nonce is None:
        nonce = os.urandom(NONCE_BYTES)
    return REQUEST_MARK + nonce + requester


def send_until_answered(endpoint: str, datagram: bytes, timeout_s: float) -> bytes | None:
    """Send a datagram to a robot's stop port again and again until the robot answers.

    Args:
        endpoint: TCP endpoint of the robot, which has the address of the stop port.
        datagram: Datagram with a nonce.
        timeout_s: Time in s after which this stops sending.

    Returns:
        The answer with the nonce of the datagram, or None if there was none.
    """
    deadline_s = time.monotonic() + timeout_s
    stop_address = parse_endpoint(endpoint)
    expected_start = ANSWER_MARK + datagram[NONCE_SLICE]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        udp_socket.settimeout(RESEND_PERIOD_S)
        while time.monotonic() < deadline_s:
            try:
                udp_socket.sendto(datagram, stop_address)
                answer, sender = udp_socket.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:  # the port is closed, or the answer has not arrived yet
                time.sleep(REFUSED_PAUSE_S)
                continue
            if sender == stop_address and answer.startswith(expected_start):
                return answer
    return None


@contextmanager
def open_false_stop_port(endpoint: str, *, knows_nonce: bool = True) -> Iterator[None]:
    """Confirm all stops at a UDP port, although there is no robot.

    Args:
        endpoint: TCP endpoint with the address of the port.
        knows_nonce: Whether the answer repeats the nonce of the request.
    """
    udp_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp_socket.bind(parse_endpoint(endpoint))
    udp_socket.settimeout(0.1)

    def answer_one_request() -> None:
        with contextlib.suppress(TimeoutError):
            request, sender = udp_socket.recvfrom(2048)
            nonce = request[NONCE_SLICE] if knows_nonce else bytes(NONCE_BYTES)
            udp_socket.sendto(ANSWER_MARK + nonce + b"planar13\nstopped", sender)

    with udp_socket, repeat_in_background(answer_one_request):
        yield


@contextmanager
def flood_stop_port(endpoint: str) -> Iterator[list[int]]:
    """Send random bytes and truncated, oversized and misspelled requests to a stop port, as fast as one thread can.

    Args:
        endpoint: TCP endpoint of the robot.

    Yields:
        A list whose only element is the number of datagrams that were sent so far.
    """
    generator = random.Random(1)
    sent_count = [0]
    nonce = bytes(NONCE_BYTES)
    valid_request = make_stop_datagram(nonce=nonce)
    wrong_datagrams = [
        *(generator.randbytes(size) for size in (0, 1, 8, 24, 100, 1400, 60_000)),
        *(valid_request[:size] for size in (1, 7, 8, 9, 23)),
        b"snakstop" + nonce + b"x",
        ANSWER_MARK + nonce + b"done",
        b"SNAKSTOQ" + nonce,
    ]
    stop_address = parse_endpoint(endpoint)
    udp_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send_one_datagram() -> None:
        with contextlib.suppress(OSError):
            udp_socket.sendto(generator.choice(wrong_datagrams), stop_address)
            sent_count[0] += 1

    with udp_socket, repeat_in_background(send_one_datagram):
        yield sent_count

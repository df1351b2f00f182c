"""The stop port: a UDP socket beside the robot's endpoint for emergency stops, independent of Zenoh.

It shares nothing with Zenoh: no session, no connection, no queue. Attacks there (half-open
connections, idle sessions, floods) leave this path open. A datagram is

    request  b"SNAKSTOP", 16 bytes chosen by the sender, name of the requester in UTF-8 (at most 64 bytes)
    answer   b"SNAKDONE", the same 16 bytes, in UTF-8: the robot's namespace, a line feed, the result
    test     b"SNAKTEST": does nothing, and is not answered; shows a sender whether the port is closed

The kernel drops all other datagrams before they are queued, so a flood of them takes no room from a stop; and a
flood of requests is a stop. Restrict access to the port by the network: stopping a robot needs no permission.

Threads: the host serves requests in the thread `stop port`. A `StopRequester` is used by one thread.
"""

import ctypes
import errno
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.workers import start_restarting_thread

REQUEST_HEADER = b"SNAKSTOP"
ANSWER_HEADER = b"SNAKDONE"
TEST = b"SNAKTEST"  # does nothing, and is never answered
NONCE_BYTES = 16
MAX_REQUESTER_BYTES = 64
MAX_ANSWER_BYTES = 1024
UDP_HEADER_BYTES = 8  # bytes
SO_ATTACH_FILTER = 26  # of Linux; Python has no name for it
# Between two requests: a flood of them must not block the interpreter.
PAUSE_AFTER_REQUEST_S = 0.001
MAX_REFUSAL_COUNT = 10  # answers of the kernel that the port is closed
REPEAT_PERIOD_S = 0.02  # after which a sender repeats an unanswered request
TEST_WAIT_S = 0.01  # for the kernel's answer that a port is closed; on loopback it comes at once

Address = tuple[str, int]  # host and port
Reply = Callable[[str], None]


def find_stop_address(endpoint: str, *, listens: bool) -> tuple[str, int]:
    """Return the host and port of a robot's stop port.

    It has the address of the endpoint on which the HAL host listens. If the host listens nowhere, or the protocol is
    not based on TCP, it is any free port of the loopback interface, which is returned as port 0.

    Args:
        endpoint: Endpoint of the robot's network.
        listens: Whether the HAL host listens on the endpoint.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if listens and protocol in ("tcp", "tls", "ws") and port.isdigit():
        return host.strip("[]"), int(port)
    return "127.0.0.1", 0


def open_stop_port(host: str, port: int) -> socket.socket:
    """Open the UDP socket on which a HAL host receives emergency stops.

    Args:
        host: IP address to listen on.
        port: Number of the port. 0 for any free port.

    Returns:
        The bound socket, with a kernel filter that drops all datagrams but requests.

    Raises:
        NotConnectedError: The port is in use.
    """
    address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
    stop_socket = socket.socket(address_family, socket.SOCK_DGRAM)
    try:
        stop_socket.bind((host, port))
        _attach_request_filter(stop_socket)
    except OSError as error:
        stop_socket.close()
        raise NotConnectedError(
            f"cannot listen for emergency stops on udp/{host}:{port}: {error.strerror}. Another run may hold the port; "
            f"choose one with --endpoint tcp/{host}:PORT",
            code="network/port-in-use",
        ) from error
    return stop_socket


def start_stop_server(
    opened: socket.socket, robot: str, handle: Callable[[str, Reply], None]
) -> None:
    """Start the thread `stop port`, which calls `handle(requester, reply)` for every stop request.

    A request consists of a constant header, a nonce that the answer repeats, and the name of the requester.

    Args:
        opened: Bound UDP socket. Closing it ends the thread.
        robot: Namespace of the robot, which the answers contain.
        handle: Function that gets the name of the requester and a function that sends the answer.
    """
    header_bytes = len(REQUEST_HEADER) + NONCE_BYTES

    def serve() -> None:
        while True:
            try:
                datagram, sender = opened.recvfrom(
                    UDP_HEADER_BYTES + header_bytes + MAX_REQUESTER_BYTES
                )
            except OSError:  # the socket is closed
                return
            if not datagram.startswith(REQUEST_HEADER) or len(datagram) < header_bytes:
                continue
            nonce = datagram[len(REQUEST_HEADER) : header_bytes]
            requester = datagram[header_bytes:].decode(errors="replace")
            reply = _make_reply(opened, nonce + robot.encode() + b"\n", sender)
            handle(requester or "an unnamed client", reply)
            time.sleep(PAUSE_AFTER_REQUEST_S)

    start_restarting_thread("stop port", serve)


@dataclass(frozen=True)
class StopAnswer:
    """The answer of a stop port."""

    robot: str  # its namespace
    text: str


class StopRequester:
    """Sends stop requests to stop ports, and tests whether they are open, over sockets that it opens once.

    After `prepare` neither needs another file descriptor. Not thread-safe.
    """

    def __init__(self) -> None:
        self._sockets: dict[Address, socket.socket] = {}

    def open_sockets(self, addresses: Collection[Address]) -> None:
        """Open a socket for each of these stop ports, and close the sockets of others.

        Raises:
            OSError: No socket can be opened.
        """
        for address in addresses:
            if address not in self._sockets:
                self._sockets[address] = _open_udp_socket(address)
        unused = [address for address in self._sockets if address not in addresses]
        for address in unused:
            self._sockets.pop(address).close()

    def request_stop(self, address: Address, requester: str, timeout_s: float) -> StopAnswer | None:
        """Send a stop request to a stop port, and repeat it until it is answered.

        Args:
            address: Host and port of the stop port.
            requester: Name of the person or program that requests the stop.
            timeout_s: Time in s after which the request is no longer repeated.

        Returns:
            The answer, or None if none arrived in time.

        Raises:
            NotConnectedError: The port is closed.
            OSError: `address` is not prepared, and no socket can be opened.
        """
        opened = self._sockets.get(address)
        if opened is None:
            opened = _open_udp_socket(address)
            self._sockets[address] = opened
        return _repeat_stop_request(opened, address, requester, timeout_s)

    def require_open_port(self, address: Address, wait_s: float = TEST_WAIT_S) -> None:
        """Check that a stop port is open, by sending a datagram that does nothing.

        The robot's kernel drops the datagram unread, so that a flood of tests takes no room from a stop. If no process
        has opened the port, the kernel answers with an error.

        Args:
            address: Host and port of the stop port.
            wait_s: Time in s to wait for the error.

        Raises:
            NotConnectedError: The port is closed or cannot be reached, or `address` is not prepared.
        """
        opened = self._sockets.get(address)
        if opened is None:
            raise NotConnectedError(
                f"no socket is prepared for udp/{address[0]}:{address[1]}",
                code="network/nothing-listens",
            )
        try:
            opened.connect(address)
            opened.send(TEST)
            errors = select.poll()
            errors.register(opened, select.POLLERR)
            errors.poll(1000 * wait_s)
            code = opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        except OSError as error:
            code = error.errno or errno.EIO
        if code == errno.ECONNREFUSED:
            raise NotConnectedError(
                f"no host takes emergency stops on udp/{address[0]}:{address[1]}"
            )
        if code:
            raise NotConnectedError(
                f"udp/{address[0]}:{address[1]} cannot be reached: {os.strerror(code)}"
            )

    def close(self) -> None:
        """Close all sockets."""
        for opened in self._sockets.values():
            opened.close()
        self._sockets.clear()


def request_stop(host: str, port: int, requester: str, timeout_s: float) -> StopAnswer | None:
    """Send a stop request to one stop port, as `StopRequester.request_stop` does.

    Raises:
        NotConnectedError: The port is closed.
    """
    with closing(StopRequester()) as stop_requester:
        return stop_requester.request_stop((host, port), requester, timeout_s)


def _open_udp_socket(address: Address) -> socket.socket:
    address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    return socket.socket(address_family, socket.SOCK_DGRAM)


def _repeat_stop_request(
    opened: socket.socket, address: Address, requester: str, timeout_s: float
) -> StopAnswer | None:
    """Send a stop request, and repeat it every REPEAT_PERIOD_S until it is answered.

    Args:
        opened: UDP socket of the requester.
        address: Host and port of the stop port.
        requester: Name of the person or program that requests the stop.
        timeout_s: Time in s after which the request is no longer repeated.

    Returns:
        The answer, or None if none arrived in time.

    Raises:
        NotConnectedError: The port is closed: it refused more than MAX_REFUSAL_COUNT requests.
    """
    nonce = os.urandom(NONCE_BYTES)
    request = REQUEST_HEADER + nonce + requester.encode()[:MAX_REQUESTER_BYTES]
    deadline_s = time.monotonic() + timeout_s
    refused_count = 0
    opened.settimeout(REPEAT_PERIOD_S)
    while time.monotonic() < deadline_s:
        try:
            opened.connect(address)  # so that the kernel accepts answers only from there
            opened.send(request)
            answer = _receive_answer(opened, nonce)
            if answer is not None:
                return answer
        except TimeoutError:
            continue
        except ConnectionRefusedError:
            refused_count += 1
            if refused_count > MAX_REFUSAL_COUNT:
                raise NotConnectedError(
                    f"no host takes emergency stops on udp/{address[0]}:{address[1]}"
                ) from None
            time.sleep(REPEAT_PERIOD_S)
        except OSError:  # the network is unreachable at present
            time.sleep(REPEAT_PERIOD_S)
    return None


def _receive_answer(opened: socket.socket, nonce: bytes) -> StopAnswer | None:
    """Wait for the answer to the request with this nonce for REPEAT_PERIOD_S. Other datagrams are ignored.

    Returns:
        The answer, or None if only other datagrams have arrived.

    Raises:
        TimeoutError: No datagram has arrived.
    """
    deadline_s = time.monotonic() + REPEAT_PERIOD_S
    while time.monotonic() < deadline_s:
        datagram = opened.recv(MAX_ANSWER_BYTES)
        if datagram.startswith(ANSWER_HEADER + nonce):
            content = datagram[len(ANSWER_HEADER) + NONCE_BYTES :].decode(errors="replace")
            robot, _, text = content.partition("\n")
            return StopAnswer(robot, text)
    return None


def _make_reply(opened: socket.socket, head: bytes, sender: object) -> Reply:
    """Return a function that sends the answer to a request, from any thread."""

    def reply(text: str) -> None:
        try:
            opened.sendto(ANSWER_HEADER + head + text.encode()[: MAX_ANSWER_BYTES - 64], sender)  # pyright: ignore
        except OSError:  # the requester has ended; the robot is stopped all the same
            return

    return reply


def _attach_request_filter(opened: socket.socket) -> None:
    """Let the kernel drop datagrams that do not start like a request, and truncate long ones.

    The filter is a program in classic BPF, whose offsets count from the start of the UDP header. If the kernel refuses
    the filter, nothing is lost: the thread that serves the requests checks each datagram, too.

    Args:
        opened: Bound UDP socket.
    """
    # The 8 bytes of the header, as BPF compares them.
    first_word, second_word = struct.unpack(">II", REQUEST_HEADER)
    max_bytes = UDP_HEADER_BYTES + len(REQUEST_HEADER) + NONCE_BYTES + MAX_REQUESTER_BYTES
    instructions = [  # (code, jump if true, jump if false, constant)
        (0x20, 0, 0, UDP_HEADER_BYTES),  # load the first word of the payload
        (0x15, 0, 3, first_word),  # if it differs, jump to the last instruction
        (0x20, 0, 0, UDP_HEADER_BYTES + 4),  # load the second word
        (0x15, 0, 1, second_word),  # if it differs, jump to the last instruction
        (0x06, 0, 0, max_bytes),  # accept this many bytes
        (0x06, 0, 0, 0),  # drop the datagram
    ]
    program = b"".join(struct.pack("HBBI", *instruction) for instruction in instructions)
    buffer = ctypes.create_string_buffer(program)  # must live until the kernel has copied it
    # `struct sock_fprog`.
    program_description = struct.pack("HL", len(instructions), ctypes.addressof(buffer))
    try:
        opened.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, program_description)
    except OSError:
        return

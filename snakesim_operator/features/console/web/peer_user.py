"""The user of this computer at the other end of a loopback connection, as the kernel knows it.

Every connection to the console comes from 127.0.0.1, so the address does not identify the user. The kernel answers for
one socket at a time, in about 10 microseconds, over a netlink socket that is opened once.

Source: linux/netlink.h, linux/sock_diag.h and linux/inet_diag.h.
"""

import contextlib
import socket
import struct

# Netlink.
NETLINK_SOCK_DIAG = 4
SOCK_DIAG_BY_FAMILY = 20
NLM_F_REQUEST = 1
MESSAGE_HEADER = struct.Struct("=IHHII")  # struct nlmsghdr: length, type, flags, sequence, port

# The request: struct inet_diag_req_v2, which ends with struct inet_diag_sockid.
REQUEST = struct.Struct("=BBBBI")  # family, protocol, ext, pad, states
PORTS = struct.Struct("!HH")  # source and destination; both addresses, interface and cookie follow
ADDRESS_BYTES = 16  # room for IPv6
ANY_INTERFACE = bytes(4)
NO_COOKIE = b"\xff" * 8
ALL_STATES = 0xFFFFFFFF

# The answer: struct inet_diag_msg.
UID_OFFSET = MESSAGE_HEADER.size + 4 + 48 + 12  # of idiag_uid, after four bytes, the socket's id and three integers
UID_BYTES = 4

ANSWER_LIMIT_S = 0.05  # the kernel answers at once; a connection must not wait longer for its user
UNKNOWN_USER = -1


class PeerUsers:
    """Finds the user at the other end of a connection."""

    def __init__(self) -> None:
        """Open the netlink socket. If that is not possible, every user is unknown."""
        self._netlink: socket.socket | None = None
        self._sequence = 0
        with contextlib.suppress(OSError):
            self._netlink = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG)
            self._netlink.settimeout(ANSWER_LIMIT_S)

    def user_of(self, connection: socket.socket) -> int:
        """Return the user id of the other end; UNKNOWN_USER if it is gone, or the kernel does not know it."""
        if self._netlink is None:
            return UNKNOWN_USER
        self._sequence += 1
        try:
            peer_address = connection.getpeername()
            own_address = connection.getsockname()
            self._netlink.send(_encode_request(self._sequence, peer_address, own_address))
            return _decode_user(_receive_answer(self._netlink, self._sequence))
        except (OSError, struct.error):
            return UNKNOWN_USER

    def close(self) -> None:
        """Close the netlink socket."""
        if self._netlink is not None:
            self._netlink.close()


def _encode_request(sequence: int, peer_address: tuple[str, int], own_address: tuple[str, int]) -> bytes:
    """Return a request for the socket at the other end, which has the peer's address as its own."""
    peer_host, peer_port = peer_address
    own_host, own_port = own_address
    socket_id = (
        PORTS.pack(peer_port, own_port)
        + socket.inet_aton(peer_host).ljust(ADDRESS_BYTES, b"\0")
        + socket.inet_aton(own_host).ljust(ADDRESS_BYTES, b"\0")
        + ANY_INTERFACE
        + NO_COOKIE
    )
    body = REQUEST.pack(socket.AF_INET, socket.IPPROTO_TCP, 0, 0, ALL_STATES) + socket_id
    length = MESSAGE_HEADER.size + len(body)
    return MESSAGE_HEADER.pack(length, SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, sequence, 0) + body


def _receive_answer(netlink: socket.socket, sequence: int) -> bytes:
    """Return the answer to a request. Answers to earlier requests, which came too late, are skipped."""
    while True:
        answer = netlink.recv(4096)
        _, _, _, answer_sequence, _ = MESSAGE_HEADER.unpack_from(answer)
        if answer_sequence == sequence:
            return answer


def _decode_user(answer: bytes) -> int:
    """Return the user id in an answer; UNKNOWN_USER if the answer is an error."""
    _, message_type, _, _, _ = MESSAGE_HEADER.unpack_from(answer)
    if message_type != SOCK_DIAG_BY_FAMILY or len(answer) < UID_OFFSET + UID_BYTES:
        return UNKNOWN_USER
    return int.from_bytes(answer[UID_OFFSET : UID_OFFSET + UID_BYTES], "little")

"""The user of this computer at the other end of a loopback connection, as the kernel has it.

Every connection to the console comes from 127.0.0.1, so an address tells nothing of who opened it. The kernel answers
for one socket at a time, in some 10 microseconds, over a netlink socket that is opened once.

Source: linux/sock_diag.h and linux/inet_diag.h.
"""

import contextlib
import socket
import struct

NETLINK_SOCK_DIAG = 4
SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST = 20, 1
ALL_STATES = 0xFFFFFFFF
NO_COOKIE = b"\xff" * 8
MESSAGE_HEADER = struct.Struct("=IHHII")  # struct nlmsghdr: length, type, flags, sequence, port
REQUEST = struct.Struct("=BBBBI")  # struct inet_diag_req_v2 before its socket: driver type, protocol, ext, pad, states
PORTS = struct.Struct("!HH")  # struct inet_diag_sockid: source and destination, then both addresses, interface, cookie
ADDRESS_BYTES = 16
UID_OFFSET = MESSAGE_HEADER.size + 4 + 48 + 12  # of idiag_uid in struct inet_diag_msg
ANSWER_S = 0.05
UNKNOWN = -1


class PeerUsers:
    """Finds the user of a connection's other end."""

    def __init__(self) -> None:
        """Open the netlink socket; without it every user is unknown."""
        self._netlink: socket.socket | None = None
        self._sequence = 0
        with contextlib.suppress(OSError):
            self._netlink = socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG)
            self._netlink.settimeout(ANSWER_S)

    def user_of(self, connection: socket.socket) -> int:
        """Return the user id of the other end; UNKNOWN when it is gone, or the kernel does not tell."""
        if self._netlink is None:
            return UNKNOWN
        self._sequence += 1
        try:
            peer, own = connection.getpeername(), connection.getsockname()
            self._netlink.send(_request(self._sequence, peer, own))
            while True:
                answer = self._netlink.recv(4096)
                _, kind, _, sequence, _ = MESSAGE_HEADER.unpack_from(answer)
                if sequence == self._sequence:
                    break
        except (OSError, struct.error):
            return UNKNOWN
        if kind != SOCK_DIAG_BY_FAMILY or len(answer) < UID_OFFSET + 4:
            return UNKNOWN
        return int.from_bytes(answer[UID_OFFSET : UID_OFFSET + 4], "little")

    def close(self) -> None:
        """Close the netlink socket."""
        if self._netlink is not None:
            self._netlink.close()


def _request(sequence: int, peer: tuple[str, int], own: tuple[str, int]) -> bytes:
    addresses = b"".join(socket.inet_aton(host).ljust(ADDRESS_BYTES, b"\0") for host in (peer[0], own[0]))
    sought = PORTS.pack(peer[1], own[1]) + addresses + bytes(4) + NO_COOKIE
    body = REQUEST.pack(socket.AF_INET, socket.IPPROTO_TCP, 0, 0, ALL_STATES) + sought
    return MESSAGE_HEADER.pack(MESSAGE_HEADER.size + len(body), SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, sequence, 0) + body

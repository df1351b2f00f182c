"""Chooses ports of the loopback interface that no other process chooses, so that they can be bound later.

A port that the kernel chooses (`bind` to port 0) and that is closed again may be given to the next process that asks,
before the first one binds it. So these ports are outside of the range from which the kernel chooses, and each process
claims a block of them for as long as it lives. The claim is a socket with a name in Linux's abstract namespace. Like
ports, such names belong to one network namespace, and the kernel releases them however the process ends.
"""

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

from snakesim_hal.base.errors import NotConnectedError

LOOPBACK = "127.0.0.1"
FIRST_PORT = 20_000  # above the ports that well-known programs listen on
DEFAULT_LIMIT = 32_768  # Linux chooses ports from here on, unless it is configured otherwise
BLOCK_PORTS = 64  # more than most processes need
LOCAL_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")

_lock = threading.Lock()
_claims: list[socket.socket] = []  # open as long as this process lives
_ports: Iterator[int] = iter(())  # that this process has claimed and not returned yet
_owner_process_id = 0  # process id; a forked child must not go on with the ports of its parent


def find_free_port() -> int:
    """Return a port that is free for TCP and UDP on loopback, and that no other call returns, in any process.

    Raises:
        NotConnectedError: All ports are in use.
    """
    global _ports, _owner_process_id
    with _lock:
        if _owner_process_id != os.getpid():
            _owner_process_id = os.getpid()
            _ports = iter(())
        while True:
            for port in _ports:
                if is_tcp_port_free(port) and _is_udp_port_free(port):
                    return port
            _ports = iter(_claim_block())


def is_tcp_port_free(port: int) -> bool:
    """Return whether Zenoh can listen at this port of the loopback interface."""
    with socket.socket() as probe:
        # As Zenoh binds: an ended connection does not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        return _can_bind(probe, port)


def _is_udp_port_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        return _can_bind(probe, port)


def _can_bind(probe: socket.socket, port: int) -> bool:
    try:
        probe.bind((LOOPBACK, port))
    except OSError:
        return False
    return True


def _claim_block() -> range:
    """Claim the next block of ports that no process has claimed. Raises NotConnectedError if there is none."""
    limit = min(_read_first_local_port(), DEFAULT_LIMIT)
    for first in range(FIRST_PORT, limit - BLOCK_PORTS + 1, BLOCK_PORTS):
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0snakesim-ports-{first}")
        except OSError:  # another process has it
            claim.close()
            continue
        _claims.append(claim)
        return range(first, first + BLOCK_PORTS)
    raise NotConnectedError(
        f"no free port on the loopback interface from {FIRST_PORT} to {limit - 1}; give one with --endpoint",
        code="network/port-in-use",
    )


def _read_first_local_port() -> int:
    """Return the first port of those from which the kernel chooses."""
    try:
        return int(LOCAL_RANGE.read_text(encoding="ascii").split()[0])
    except (OSError, ValueError, IndexError):
        return DEFAULT_LIMIT

"""The console's port, on loopback only. It is open before there is a page behind it: browsers that come early wait."""

import contextlib
import socket

from snakesim_hal.base.errors import NotConnectedError

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080


def open_port(port: int | None) -> socket.socket:
    """A listening socket. port: None takes 8080, or any free one. Raises NotConnectedError."""
    for wanted in (DEFAULT_PORT, 0) if port is None else (port,):
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, wanted))
    raise NotConnectedError(f"--port {port}: another program listens there; choose another, or leave --port out")


def address_of(listening: socket.socket) -> str:
    """What to type into a browser."""
    return f"http://{LOOPBACK}:{listening.getsockname()[1]}"

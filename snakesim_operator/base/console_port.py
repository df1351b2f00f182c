"""Opens the console's port, on loopback only, before the console starts: browsers that connect early wait."""

import contextlib
import socket

from snakesim_hal.base.errors import NotConnectedError

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080


def open_port(port: int | None) -> socket.socket:
    """Open a listening socket. Raises NotConnectedError when the port is in use.

    port: None takes 8080, or any free port if that is in use.
    """
    candidates = (DEFAULT_PORT, 0) if port is None else (port,)
    for candidate in candidates:
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, candidate))
    raise NotConnectedError(
        f"--port {port}: another program listens there; choose another, or leave --port out", code="network/port-in-use"
    )


def page_address(listening: socket.socket) -> str:
    """Return the address of the console's page, for a browser."""
    port = listening.getsockname()[1]
    return f"http://{LOOPBACK}:{port}"

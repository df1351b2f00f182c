"""Opens the sockets of the console before its processes start, so that browsers that connect early wait.

Browsers connect to a port on loopback, where the front server listens. It passes their requests on to the page server
over a Unix socket, in a folder that only this user can enter.
"""

import contextlib
import secrets
import socket
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.base.errors import NotConnectedError

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
TOKEN_BYTES = 16  # random bytes in the token
TOKEN_VARIABLE = "SNAKESIM_CONSOLE_TOKEN"
PAGES_BACKLOG = 128  # connections that wait until the page server accepts them


@dataclass(frozen=True)
class ConsolePorts:
    """Sockets and secret of the two processes of one console."""

    browser_socket: socket.socket  # of the front server, on loopback, to which browsers connect
    page_socket: (
        socket.socket
    )  # of the page server, a Unix socket to which the front server connects
    page_socket_path: Path
    token: str  # first part of the path in the address of each page; secret

    @property
    def address(self) -> str:
        """Address of the page of the console, for a browser."""
        return make_page_address(self.browser_socket, self.token)

    def close(self) -> None:
        """Close the sockets in this process. Processes that inherited them are not affected."""
        self.browser_socket.close()
        self.page_socket.close()


@contextlib.contextmanager
def open_console_ports(port: int | None) -> Iterator[ConsolePorts]:
    """Open the sockets of the two servers of the console, and choose a secret token.

    Browsers connect to the front server, which passes their requests on to the page server, the process that draws the
    pages.

    Args:
        port: Port for browsers; None for the default port, or for any free port if the default port is in use.

    Yields:
        The open sockets, which are closed when the context ends.

    Raises:
        NotConnectedError: A port was given, and it is in use.
    """
    with contextlib.ExitStack() as exit_stack:
        browser_socket = exit_stack.enter_context(open_port(port))
        folder = Path(
            exit_stack.enter_context(tempfile.TemporaryDirectory(prefix="snakesim-console-"))
        )
        page_socket = exit_stack.enter_context(socket.socket(socket.AF_UNIX))
        page_socket_path = folder / "pages"
        page_socket.bind(str(page_socket_path))
        page_socket.listen(PAGES_BACKLOG)
        yield ConsolePorts(
            browser_socket, page_socket, page_socket_path, secrets.token_urlsafe(TOKEN_BYTES)
        )


def open_port(port: int | None) -> socket.socket:
    """Open a listening socket on loopback.

    Args:
        port: Port to listen on; None for DEFAULT_PORT, or for any free port if DEFAULT_PORT is in use.

    Raises:
        NotConnectedError: A port was given, and it is in use.
    """
    candidates = (DEFAULT_PORT, 0) if port is None else (port,)
    for candidate in candidates:
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, candidate))
    raise NotConnectedError(
        f"--port {port}: another program listens there; choose another, or leave --port out",
        code="network/port-in-use",
    )


def make_page_address(listening: socket.socket, token: str) -> str:
    """Make the address of the page of the console, for a browser."""
    port = listening.getsockname()[1]
    return f"http://{LOOPBACK}:{port}/{token}/"

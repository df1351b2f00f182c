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

    browsers: socket.socket  # socket of the front server, on loopback
    pages: socket.socket  # Unix socket of the page server
    pages_path: Path
    token: str  # first part of the path in the address of each page; secret

    @property
    def address(self) -> str:
        """Address of the page of the console, for a browser."""
        return make_page_address(self.browsers, self.token)

    def close(self) -> None:
        """Close the sockets in this process. Processes that inherited them are not affected."""
        self.browsers.close()
        self.pages.close()


@contextlib.contextmanager
def open_console_ports(port: int | None) -> Iterator[ConsolePorts]:
    """Open the sockets of the console, for browsers and for its page server, and choose a secret token.

    Args:
        port: Port for browsers; None for the default port, or any free port if that is in use.

    Yields:
        The open sockets, which are closed when the context ends.

    Raises:
        NotConnectedError: The port is in use.
    """
    with contextlib.ExitStack() as exit_stack:
        browsers = exit_stack.enter_context(open_port(port))
        folder = Path(
            exit_stack.enter_context(tempfile.TemporaryDirectory(prefix="snakesim-console-"))
        )
        pages = exit_stack.enter_context(socket.socket(socket.AF_UNIX))
        pages_path = folder / "pages"
        pages.bind(str(pages_path))
        pages.listen(PAGES_BACKLOG)
        yield ConsolePorts(browsers, pages, pages_path, secrets.token_urlsafe(TOKEN_BYTES))


def open_port(port: int | None) -> socket.socket:
    """Open a listening socket on loopback.

    Args:
        port: Port to listen on; None for DEFAULT_PORT, or any free port if that is in use.

    Raises:
        NotConnectedError: The port is in use.
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

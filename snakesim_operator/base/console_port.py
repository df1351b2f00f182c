"""Opens what the console listens on, before its processes start: browsers that connect early wait.

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
TOKEN_BYTES = 16  # of randomness
TOKEN_VARIABLE = "SNAKESIM_CONSOLE_TOKEN"
PAGES_BACKLOG = 128  # connections that wait until the page server accepts them


@dataclass(frozen=True)
class ConsolePorts:
    """What the two processes of one console listen on."""

    browsers: socket.socket  # of the front server, on loopback
    pages: socket.socket  # of the page server, a Unix socket
    pages_path: Path
    token: str  # first part of the path in the address of each page; secret

    @property
    def address(self) -> str:
        """The address of the console's page, for a browser."""
        return page_address(self.browsers, self.token)

    def close(self) -> None:
        """Close the sockets in this process. The processes that inherited them go on."""
        self.browsers.close()
        self.pages.close()


@contextlib.contextmanager
def open_console_ports(port: int | None) -> Iterator[ConsolePorts]:
    """Open the sockets of the console, for browsers and for its page server, and choose a secret token.

    Args:
        port: The port for browsers; None: the default port, or any free one if that is in use.

    Raises:
        NotConnectedError: The port is in use.
    """
    with contextlib.ExitStack() as opened:
        browsers = opened.enter_context(open_port(port))
        folder = Path(opened.enter_context(tempfile.TemporaryDirectory(prefix="snakesim-console-")))
        pages = opened.enter_context(socket.socket(socket.AF_UNIX))
        pages_path = folder / "pages"
        pages.bind(str(pages_path))
        pages.listen(PAGES_BACKLOG)
        yield ConsolePorts(browsers, pages, pages_path, secrets.token_urlsafe(TOKEN_BYTES))


def open_port(port: int | None) -> socket.socket:
    """Open a listening socket on loopback. Raises NotConnectedError when the port is in use.

    port: None takes 8080, or any free port if that is in use.
    """
    candidates = (DEFAULT_PORT, 0) if port is None else (port,)
    for candidate in candidates:
        with contextlib.suppress(OSError):
            return socket.create_server((LOOPBACK, candidate))
    raise NotConnectedError(
        f"--port {port}: another program listens there; choose another, or leave --port out", code="network/port-in-use"
    )


def page_address(listening: socket.socket, token: str) -> str:
    """Return the address of the console's page, for a browser."""
    port = listening.getsockname()[1]
    return f"http://{LOOPBACK}:{port}/{token}/"

"""The web server of the console: viser, on loopback only, and closed to pages of other sites."""

import contextlib
import io
import re
import socket
from collections.abc import Iterator
from typing import Any

import viser
import websockets.asyncio.server

from snakesim_hal.errors import NotConnectedError

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8080
# A browser names the page that opens a connection. Any site could connect to loopback from the operator's browser, and
# arm the robot; so only pages that came from this computer may (through an SSH tunnel too, under any port).
OUR_PAGES = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")


class PageServer(viser.ViserServer):
    """Without viser's tunnel to the public internet, which any viewer could open."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused."""
        return None


@contextlib.contextmanager
def page_server(port: int | None) -> Iterator[tuple[PageServer, str]]:
    """The server and its address. port: None takes 8080, or any free one. Raises NotConnectedError."""
    chosen = _free_port(port)
    with _only_our_pages(), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = PageServer(LOOPBACK, chosen, label="SnakeSIM", verbose=False)
    try:
        if server.get_port() != chosen:
            raise NotConnectedError(f"port {chosen} of the console was taken just now; start it again")
        yield server, f"http://{LOOPBACK}:{chosen}"
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _free_port(port: int | None) -> int:
    for wanted in (DEFAULT_PORT, 0) if port is None else (port,):
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, wanted))
            return probe.getsockname()[1]
    raise NotConnectedError(f"--port {port}: another program listens there; choose another, or leave --port out")


@contextlib.contextmanager
def _only_our_pages() -> Iterator[None]:
    """Have viser's server check where a page came from; viser has no option for it."""
    serve = websockets.asyncio.server.serve

    def checking(*arguments: Any, **options: Any) -> Any:
        return serve(*arguments, origins=[OUR_PAGES, None], **options)

    websockets.asyncio.server.serve = checking  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]

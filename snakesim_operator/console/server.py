"""The web server of the console: viser, on loopback only, and closed to pages of other sites."""

import asyncio
import contextlib
import io
import re
import socket
import threading
from collections.abc import Iterator
from typing import Any

import viser
import websockets.asyncio.server

from snakesim_operator.console.pacing import pace
from snakesim_operator.console.port import LOOPBACK, address_of

# A browser names the page that opens a connection. Any site could connect to loopback from the operator's browser, and
# arm the robot; so only pages that came from this computer may (through an SSH tunnel too, under any port).
OUR_PAGES = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\])(:\d+)?")


class PageServer(viser.ViserServer):
    """Without viser's tunnel to the public internet, which any viewer could open."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused."""
        return None


@contextlib.contextmanager
def page_server(listening: socket.socket) -> Iterator[tuple[PageServer, str]]:
    """The server on a socket of `port.open_port`, and its address."""
    complete = threading.Event()
    with _on_our_terms(listening, complete), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = PageServer(LOOPBACK, listening.getsockname()[1], label="SnakeSIM", verbose=False)
    pace(server)
    complete.set()
    try:
        yield server, address_of(listening)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


@contextlib.contextmanager
def _on_our_terms(listening: socket.socket, complete: threading.Event) -> Iterator[None]:
    """Have viser's server use the open socket, and check where a page came from; viser has no option for either.

    Pages that have waited at the socket are let in when the server is complete: viser begins to listen before it is.
    """
    serve = websockets.asyncio.server.serve

    def serve_here(handler: Any, _host: str, _port: int, **options: Any) -> Any:
        async def let_in(connection: Any) -> None:
            while not complete.is_set():
                await asyncio.sleep(0.01)
            await handler(connection)

        return serve(let_in, sock=listening, origins=[OUR_PAGES, None], **options)

    websockets.asyncio.server.serve = serve_here  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]

"""Answers the requests that the front server passes on, and relays messages between each browser and viser."""

import asyncio
import contextlib
import http
import logging
import socket
import threading
from collections.abc import Callable

from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, unix_serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from snakesim_operator.base.byte_relay import run_until_one_ends
from snakesim_operator.features.console.web.browser import BrowserConnection
from snakesim_operator.features.console.web.viser_server import PageServer

MAX_VIEWERS = 64
MAX_MESSAGE_BYTES = 64 * 1024  # of a browser; far above any message of a page
PAGE_PATHS = ("/", "/index.html")
VISER_PROTOCOL = "viser-v"  # how the name of viser's protocol begins; a version follows

# Codes with which a websocket is closed.
MESSAGE_TOO_BIG = 1009
TRY_AGAIN_LATER = 1013
UNSENT_CODES = (None, 1005, 1006)  # no code: the connection is open, or was lost

AnswerRequest = Callable[[Request], Response | None]


class BrowserRelay:
    """Serves browsers in a thread of its own, for as long as its context lasts."""

    def __init__(
        self,
        listening_socket: socket.socket,
        page_server: PageServer,
        page_html: bytes,
        answer_first: AnswerRequest,
    ) -> None:
        """Prepare the relay between browsers and viser, whose thread starts with the context.

        Args:
            listening_socket: The Unix socket at which the front server connects.
            page_server: Receives the messages of browsers.
            page_html: The console's page.
            answer_first: Answers requests for other pages than the console's; returns None for an unknown page.
        """
        self._listening_socket = listening_socket
        self._page_server = page_server
        self._page = page_html
        self._handle_first = answer_first
        self._open_browsers: set[BrowserConnection] = set()
        # Bytes that are no websocket are no errors of the console.
        self._quiet_logger = logging.getLogger(f"{__name__}.websockets")
        self._quiet_logger.addHandler(logging.NullHandler())
        self._quiet_logger.propagate = False
        # The thread.
        self._loop = asyncio.new_event_loop()
        self._stop_event = asyncio.Event()
        self._thread = threading.Thread(
            target=self._loop.run_until_complete,
            args=(self._serve_browsers(),),
            name="page server",
            daemon=True,
        )

    def __enter__(self) -> "BrowserRelay":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._stop_event.set)
        self._thread.join()
        self._loop.close()

    async def _serve_browsers(self) -> None:
        """Serve until the context ends."""
        server = await unix_serve(
            self._serve_browser,
            sock=self._listening_socket,
            process_request=self._answer_request,
            select_subprotocol=_select_viser_protocol,
            max_size=MAX_MESSAGE_BYTES,
            compression=None,
            logger=self._quiet_logger,
        )
        await self._stop_event.wait()
        server.close()
        await server.wait_closed()

    # --- pages -----------------------------------------------------------------------------------------------

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer an HTTP request for a page; return None for a websocket, which the library then connects.

        Args:
            connection: The connection of the browser.
            request: The request, with its path and headers.
        """
        if "Upgrade" in request.headers:
            return None
        response = self._handle_first(request)
        if response is not None:
            return response
        if request.path.partition("?")[0] not in PAGE_PATHS:
            return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no such page\n")
        headers = Headers(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(self._page)),
                "Content-Security-Policy": "frame-ancestors 'none'",
                "Referrer-Policy": "no-referrer",
            }
        )
        return Response(http.HTTPStatus.OK.value, http.HTTPStatus.OK.phrase, headers, self._page)

    # --- messages --------------------------------------------------------------------------------------------

    async def _serve_browser(self, connection: ServerConnection) -> None:
        """Relay the messages of one browser until it leaves."""
        assert connection.request is not None
        browser = BrowserConnection(connection.request, self._page_server.admission)
        if len(self._open_browsers) >= MAX_VIEWERS:
            reason = f"more than {MAX_VIEWERS} pages are open"
            browser.drop("too many viewers", reason)
            await connection.close(TRY_AGAIN_LATER, reason)
            return
        self._open_browsers.add(browser)
        try:
            await self._connect_to_viser(connection, browser)
        except (OSError, TimeoutError, WebSocketException) as error:
            browser.drop("no answer of viser", str(error))
            await connection.close(
                TRY_AGAIN_LATER, "the console does not answer; load the page again"
            )
        finally:
            self._open_browsers.discard(browser)

    async def _connect_to_viser(
        self, connection: ServerConnection, browser: BrowserConnection
    ) -> None:
        """Open a connection to viser for a browser, and relay messages in both directions until either side ends."""
        protocols = None if connection.subprotocol is None else [connection.subprotocol]
        with self._page_server.expect_browser(browser) as address:
            opening = connect(
                address,
                subprotocols=protocols,
                compression=None,
                max_size=None,
                ping_interval=None,
                proxy=None,
            )
            async with opening as to_viser:
                await _relay_messages(browser, connection, to_viser)
        if to_viser.close_code not in UNSENT_CODES:  # such as that the page is of another version
            await connection.close(to_viser.close_code, to_viser.close_reason or "")


async def _relay_messages(
    browser: BrowserConnection, connection: ServerConnection, to_viser: ClientConnection
) -> None:
    """Relay messages in both directions until either side ends."""
    to_viser_direction = _relay_to_viser(browser, connection, to_viser)
    to_browser_direction = _relay_to_browser(to_viser, connection)
    await run_until_one_ends(to_viser_direction, to_browser_direction)


async def _relay_to_viser(
    browser: BrowserConnection, connection: ServerConnection, to_viser: ClientConnection
) -> None:
    """Pass each message of a browser that is admitted on to viser, until a connection is closed."""
    await browser.wait_for_number()
    try:
        async for data in connection:
            await browser.wait_for_allowance()
            checked = browser.check_message(data)
            if checked is not None:
                await to_viser.send(checked)
    except ConnectionClosed as closed:
        if closed.sent is not None and closed.sent.code == MESSAGE_TOO_BIG:
            browser.drop(
                "too long", f"more than {MAX_MESSAGE_BYTES} bytes; its connection was closed"
            )


async def _relay_to_browser(to_viser: ClientConnection, connection: ServerConnection) -> None:
    """Pass each message of viser on to a browser, until a connection is closed."""
    with contextlib.suppress(ConnectionClosed):
        async for data in to_viser:
            await connection.send(data)


def _select_viser_protocol(
    _connection: ServerConnection, offered: list[Subprotocol]
) -> Subprotocol | None:
    """Return the protocol of viser's page. viser itself compares its version."""
    for protocol in offered:
        if protocol.startswith(VISER_PROTOCOL):
            return protocol
    return None

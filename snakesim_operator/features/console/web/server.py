"""The web server of the console: viser on loopback only, closed to other pages, and behind the console's checks.

`connection_acceptor` accepts the connections, and has the second stop. `admission` decides which messages viser gets to
read.
"""

import contextlib
import dataclasses
import io
import logging
import socket
import time
import uuid
from collections.abc import Awaitable, Callable, Iterator
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from snakesim_operator.base.console_port import LOOPBACK, page_address
from snakesim_operator.base.page_origin import explain_refusal
from snakesim_operator.features.console.web.admission import Admission
from snakesim_operator.features.console.web.browser_connection import MAX_MESSAGE_BYTES, BrowserConnection
from snakesim_operator.features.console.web.connection_acceptor import ConnectionAcceptor, StopPath
from snakesim_operator.features.console.web.handoff_listener import HandoffListener
from snakesim_operator.features.console.web.pacing import ask_page, pace_pages

MAX_VIEWERS = 64
CONSOLE_PATHS = ("/", "/index.html")
TRY_AGAIN_LATER = 1013  # code with which a websocket is closed

# A cookie, which the browser sends as it connects: viser's page has no message for this.
DARK_COOKIE = "snakesim-dark=true"

# What is added to viser's page.
SECOND_STOP = Path(__file__).with_name("second_stop.html").read_bytes()
DARK_COOKIE_SCRIPT = (
    b'<script>document.cookie = "snakesim-dark=" + matchMedia("(prefers-color-scheme: dark)").matches'
    b' + "; path=/; SameSite=Strict"</script>'
)
STICKY_HEADER_STYLE = (  # of `page_html.format_header`: what is below is scrolled behind it
    b"<style>div:has(> [data-robot]) {position: sticky; top: 0; z-index: 5; background: var(--mantine-color-body);"
    b" padding-top: 2px} div:has(> div > div > div > [data-robot]) {overflow: clip !important; min-width: 0}"
    b' @media (max-width: 480px) {div[style*="width: 20em"] {width: 100% !important}}</style>'  # a phone's panel
)
TABS_IN_ONE_LINE_STYLE = (  # on a phone they wrap; viser's tabs have no class, but a style of their own
    b"<style>@media (min-width: 481px) {"
    b'div[style*="background-size: 100% 2.4em"] {flex-wrap: nowrap !important; overflow-x: auto !important}'
    b' div[style*="padding: 0px 0.9em"][style*="max-width: 14em"] {padding: 0 0.3em !important; flex-shrink: 0}'
    b"}</style>"
)
# Releases a held button when its page loses the keyboard, or is hidden: the finger may come up elsewhere.
RELEASE_HELD_BUTTON_SCRIPT = b"""<script>(() => {
  let held = null;
  addEventListener("pointerdown", event => { held = event.target; }, true);
  const end = () => { held?.dispatchEvent(new PointerEvent("pointercancel", {bubbles: true})); held = null; };
  addEventListener("blur", end);
  addEventListener("pagehide", end);
  document.addEventListener("visibilitychange", () => { if (document.hidden) end(); });
})()</script>"""

ProcessRequest = Callable[[ServerConnection, Request], Response | None]
AnswerRequest = Callable[[Request], Response | None]

_connecting: ContextVar[BrowserConnection] = ContextVar("connecting")  # the browser that viser is numbering


class PageServer(viser.ViserServer):
    """viser's server, without its tunnel to the public internet, which any viewer could open.

    viser counts only pages that can draw the scene; this server knows all of them by their connections.
    """

    admission: Admission

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._browsers: WeakValueDictionary[int, BrowserConnection] = WeakValueDictionary()  # by viewer
        self._websock_server.on_client_connect(self._on_viewer_numbered)
        self._websock_server.on_client_disconnect(self._on_viewer_gone)

    def _on_viewer_numbered(self, client: Any) -> None:
        """Note the number that viser gave a viewer. Until then nothing that its browser sends is passed on."""
        browser = _connecting.get()
        browser.viewer = client.client_id
        self._browsers[client.client_id] = browser

    def _on_viewer_gone(self, client: Any) -> None:
        self._browsers.pop(client.client_id, None)

    def prefers_dark(self, viewer: int) -> bool:
        """Return whether a viewer's browser was set to dark pages when it connected."""
        browser = self._browsers.get(viewer)
        if browser is None or browser.request is None:
            return False
        cookies = "; ".join(browser.request.headers.get_all("Cookie"))
        return DARK_COOKIE in cookies.split("; ")

    def viewers(self) -> int:
        """Return how many pages are open, also of those that cannot draw the scene."""
        return len(self._browsers)

    def ask_for_age(self, viewer: int, robot_ns: int | None) -> None:
        """Send a viewer's page the next question by which the age of its messages is known.

        Args:
            viewer: The viewer to ask.
            robot_ns: The robot's time now, if it is known.
        """
        browser = self._browsers.get(viewer)
        page = self.get_clients().get(viewer)
        if browser is None or page is None or not browser.age.may_ask():
            return
        question = uuid.uuid4().hex
        browser.age.note_question(question, time.monotonic(), robot_ns)
        ask_page(page, question)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to open a tunnel."""
        return None


@contextlib.contextmanager
def serve_pages(
    listening: socket.socket,
    report: Callable[[str], None] = lambda _: None,
    stop: StopPath | None = None,
    answer_first: AnswerRequest = lambda _: None,
) -> Iterator[tuple[PageServer, str]]:
    """Run the web server, and yield it and its address.

    Args:
        listening: Where browsers connect: a socket of `console_port.open_port`.
        report: Called with what was refused, once of each kind.
        stop: Stops the robot for the pages' second stop; None for a recording.
        answer_first: Answers requests for pages beside the console's; returns None for a page that it does not have.
    """
    admission = Admission(report)
    handoff = HandoffListener(listening.getsockname())
    added_html = DARK_COOKIE_SCRIPT + STICKY_HEADER_STYLE + TABS_IN_ONE_LINE_STYLE
    if stop is not None:
        added_html = SECOND_STOP + RELEASE_HELD_BUTTON_SCRIPT + added_html
    with _patch_websocket_server(handoff, admission, answer_first, added_html), _ignore_output():
        server = PageServer(LOOPBACK, listening.getsockname()[1], label="SnakeSIM", verbose=False)
    server.admission = admission
    pace_pages(server)
    with ConnectionAcceptor(listening, handoff, stop, lambda kind, reason: admission.drop(None, kind, reason)):
        try:
            yield server, page_address(listening)
        finally:
            with _ignore_output():
                server.stop()


def _ignore_output() -> contextlib.AbstractContextManager[Any]:
    """Drop what viser prints as it starts and stops."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _patch_websocket_server(
    handoff: HandoffListener, admission: Admission, answer_first: AnswerRequest, added_html: bytes
) -> Iterator[None]:
    """Have viser start its server with the console's listener and checks, for which viser has no option."""
    original_serve = websockets.asyncio.server.serve
    # Bytes that are no websocket are counted by `admission`; they are no errors of the console.
    quiet_logger = logging.getLogger(f"{__name__}.websockets")
    quiet_logger.addHandler(logging.NullHandler())
    quiet_logger.propagate = False

    def serve_with_checks(handler: Any, _host: str, _port: int, **options: Any) -> Any:
        process_request = _check_requests(options["process_request"], admission, answer_first, added_html)
        console_options = {
            "max_size": MAX_MESSAGE_BYTES,
            "create_connection": partial(BrowserConnection, admission),
            "logger": quiet_logger,
            "process_request": process_request,
        }
        return original_serve(_limit_viewers(handler, admission), sock=handoff, **(options | console_options))

    websockets.asyncio.server.serve = serve_with_checks  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original_serve  # pyright: ignore[reportAttributeAccessIssue]


def _limit_viewers(handler: Any, admission: Admission) -> Callable[[Any], Awaitable[None]]:
    """Return viser's handler of a connection, for no more than MAX_VIEWERS connections at a time."""
    open_connections: set[BrowserConnection] = set()

    async def handle_connection(connection: Any) -> None:  # a BrowserConnection
        if len(open_connections) >= MAX_VIEWERS:
            reason = f"more than {MAX_VIEWERS} pages are open"
            admission.drop(None, "too many viewers", reason)
            await connection.close(TRY_AGAIN_LATER, reason)
            return
        open_connections.add(connection)
        _connecting.set(connection)
        try:
            await handler(connection)
        finally:
            open_connections.discard(connection)

    return handle_connection


def _check_requests(
    viser_answer: ProcessRequest, admission: Admission, answer_first: AnswerRequest, added_html: bytes
) -> ProcessRequest:
    """Return a function that answers the requests of the console's own pages only.

    Args:
        viser_answer: viser's own answer to a request; None lets a websocket connect.
        admission: Counts requests that are refused.
        answer_first: Answers requests for pages beside the console's.
        added_html: Added to viser's page.
    """

    def process_request(connection: ServerConnection, request: Request) -> Response | None:
        refusal = explain_refusal(request.headers.get("Host"), request.headers.get("Origin"))
        if refusal is not None:
            admission.drop(None, "another origin", refusal)
            return connection.respond(403, f"{refusal}\n")
        if "Upgrade" in request.headers:  # a websocket
            return viser_answer(connection, request)
        response = answer_first(request)
        if response is not None:
            return response
        path = request.path.partition("?")[0]
        if path not in CONSOLE_PATHS:
            return viser_answer(connection, request)
        request_without_compression = dataclasses.replace(request, headers=Headers())
        page = viser_answer(connection, request_without_compression)
        assert page is not None
        return _add_html(added_html, page)

    return process_request


def _add_html(added_html: bytes, page: Response) -> Response:
    """Return a page with HTML added before all else, where no script of viser can keep it from running.

    Pages of other origins cannot show the page in a frame.
    """
    before, head, after = page.body.partition(b"<head>")
    body = added_html + page.body
    if head:
        body = before + head + added_html + after
    headers = Headers(
        {
            "Content-Type": page.headers["Content-Type"],
            "Content-Length": str(len(body)),
            "Content-Security-Policy": "frame-ancestors 'none'",
        }
    )
    return dataclasses.replace(page, headers=headers, body=body)

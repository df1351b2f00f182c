"""The web server of the console: viser, on loopback only, closed to other pages, and behind our checks.

`front` accepts, and has the second stop; `admission` decides what viser gets to read.
"""

import contextlib
import dataclasses
import io
import logging
import socket
import time
import uuid
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from snakesim_operator.base.console_port import LOOPBACK, address_of
from snakesim_operator.base.page_origin import why_refused
from snakesim_operator.features.console.web.admission import Admission
from snakesim_operator.features.console.web.browser_connection import MAX_MESSAGE_BYTES, BrowserConnection
from snakesim_operator.features.console.web.connection_acceptor import ConnectionAcceptor, HandoffListener, StopPath
from snakesim_operator.features.console.web.pacing import ask_page, pace_pages

MOST_VIEWERS = 64
PAGES = ("/", "/index.html")
SECOND_STOP = Path(__file__).with_name("second_stop.html").read_bytes()
DARK = "snakesim-dark=true"  # a cookie, which the browser sends as it connects: viser's page has no message for this
PREFERENCE = (
    b'<script>document.cookie = "snakesim-dark=" + matchMedia("(prefers-color-scheme: dark)").matches'
    b' + "; path=/; SameSite=Strict"</script>'
)
STATE_IN_SIGHT = (  # of `page_html.header`: what is below is scrolled behind it
    b"<style>div:has(> [data-robot]) {position: sticky; top: 0; z-index: 5; background: var(--mantine-color-body);"
    b" padding-top: 2px} div:has(> div > div > div > [data-robot]) {overflow: clip !important; min-width: 0}"
    b' @media (max-width: 480px) {div[style*="width: 20em"] {width: 100% !important}}</style>'  # a phone's panel
)
TABS_IN_ONE_LINE = (  # on a phone they wrap; viser's tabs have no class, but a style of their own
    b"<style>@media (min-width: 481px) {"
    b'div[style*="background-size: 100% 2.4em"] {flex-wrap: nowrap !important; overflow-x: auto !important}'
    b' div[style*="padding: 0px 0.9em"][style*="max-width: 14em"] {padding: 0 0.3em !important; flex-shrink: 0}'
    b"}</style>"
)
# A button that was held is let go when its page loses the keyboard, or is hidden: the finger may come up elsewhere.
HOLD_ENDS = b"""<script>(() => {
  let held = null;
  addEventListener("pointerdown", event => { held = event.target; }, true);
  const end = () => { held?.dispatchEvent(new PointerEvent("pointercancel", {bubbles: true})); held = null; };
  addEventListener("blur", end);
  addEventListener("pagehide", end);
  document.addEventListener("visibilitychange", () => { if (document.hidden) end(); });
})()</script>"""
Answer = Callable[[ServerConnection, Request], Response | None]
More = Callable[[Request], Response | None]
_connecting: ContextVar[BrowserConnection] = ContextVar("connecting")


class PageServer(viser.ViserServer):
    """Without viser's tunnel to the public internet, which any viewer could open."""

    admission: Admission

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._browsers: WeakValueDictionary[int, BrowserConnection] = WeakValueDictionary()
        self._websock_server.on_client_connect(self._number)
        self._websock_server.on_client_disconnect(self._forget)

    def _number(self, viewer: Any) -> None:
        """viser has numbered a viewer: until then nothing that its browser says is passed on."""
        browser = _connecting.get()
        browser.viewer = viewer.client_id
        self._browsers[viewer.client_id] = browser

    def _forget(self, viewer: Any) -> None:
        self._browsers.pop(viewer.client_id, None)

    def prefers_dark(self, viewer: int) -> bool:
        """Whether a viewer's browser or system is set to dark pages, as it said when it connected."""
        browser = self._browsers.get(viewer)
        if browser is None or browser.request is None:
            return False
        return DARK in "; ".join(browser.request.headers.get_all("Cookie")).split("; ")

    def viewers(self) -> int:
        """Return how many pages are open, also of those that cannot draw the scene."""
        return len(self._browsers)

    def ask_for_age(self, viewer: int, robot_ns: int | None) -> None:
        """Ask a viewer's page the next question by which the age of its messages is known.

        robot_ns: the robot's time now, if it is known.
        """
        browser, page = self._browsers.get(viewer), self.get_clients().get(viewer)
        if browser is None or page is None or not browser.age.may_ask():
            return
        question = uuid.uuid4().hex
        browser.age.ask(question, time.monotonic(), robot_ns)
        ask_page(page, question)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused."""
        return None


@contextlib.contextmanager
def page_server(
    listening: socket.socket,
    report: Callable[[str], None] = lambda _: None,
    stop: StopPath | None = None,
    more: More = lambda _: None,
) -> Iterator[tuple[PageServer, str]]:
    """The server on a socket of `port.open_port`, and its address.

    Args:
        listening: Where browsers connect.
        report: Called with what was refused, once of each kind.
        stop: Stops the robot for the pages' backup stop; None for a recording.
        more: Answers requests for pages beside the console's; returns None for one that it does not have.
    """
    admission, handed_on = Admission(report), HandoffListener(listening.getsockname())
    with _on_our_terms(handed_on, admission, stop is not None, more), contextlib.redirect_stdout(io.StringIO()):
        server = PageServer(LOOPBACK, listening.getsockname()[1], label="SnakeSIM", verbose=False)  # prints a banner
    server.admission = admission
    pace_pages(server)
    with ConnectionAcceptor(listening, handed_on, stop, lambda kind, why: admission.drop(None, kind, why)):
        try:
            yield server, address_of(listening)
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()


@contextlib.contextmanager
def _on_our_terms(handed_on: HandoffListener, admission: Admission, stops: bool, more: More) -> Iterator[None]:
    """Have viser's server take connections from the front, with our checks; viser has no option for either."""
    serve = websockets.asyncio.server.serve
    quiet = logging.getLogger(f"{__name__}.websockets")  # a stranger's bytes are counted, and are no errors of ours
    quiet.addHandler(logging.NullHandler())
    quiet.propagate = False

    def serve_here(handler: Any, _host: str, _port: int, **options: Any) -> Any:
        viewers: set[BrowserConnection] = set()

        async def let_in(connection: Any) -> None:  # a Browser, as made below
            if len(viewers) >= MOST_VIEWERS:
                admission.drop(None, "too many viewers", f"more than {MOST_VIEWERS} pages are open")
                await connection.close(1013, f"more than {MOST_VIEWERS} pages are open")
                return
            viewers.add(connection)
            _connecting.set(connection)
            try:
                await handler(connection)
            finally:
                viewers.discard(connection)

        def made(*arguments: Any, **more: Any) -> BrowserConnection:
            return BrowserConnection(admission, *arguments, **more)

        ours = {
            "max_size": MAX_MESSAGE_BYTES,
            "create_connection": made,
            "logger": quiet,
            "process_request": _checked(options["process_request"], admission, stops, more),
        }
        return serve(let_in, sock=handed_on, **(options | ours))

    websockets.asyncio.server.serve = serve_here  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]


def _checked(answer: Answer, admission: Admission, stops: bool, more: More) -> Answer:
    """Answer requests of our own pages only. viser's page gets our scripts, and cannot be framed by others."""

    def check(connection: ServerConnection, request: Request) -> Response | None:
        why = why_refused(request.headers.get("Host"), request.headers.get("Origin"))
        if why is not None:
            admission.drop(None, "another origin", why)
            return connection.respond(403, f"{why}\n")
        if "Upgrade" not in request.headers and (found := more(request)) is not None:
            return found
        if request.path.partition("?")[0] not in PAGES or "Upgrade" in request.headers:
            return answer(connection, request)
        page = answer(connection, dataclasses.replace(request, headers=Headers()))  # as it is, without compression
        assert page is not None
        return _with((SECOND_STOP + HOLD_ENDS if stops else b"") + PREFERENCE + STATE_IN_SIGHT + TABS_IN_ONE_LINE, page)

    return check


def _with(ours: bytes, page: Response) -> Response:
    """First of all in the page: then nothing of viser's can keep it from running."""
    before, head, after = page.body.partition(b"<head>")
    body = before + head + ours + after if head else ours + page.body
    headers = Headers(
        {
            "Content-Type": page.headers["Content-Type"],
            "Content-Length": str(len(body)),
            "Content-Security-Policy": "frame-ancestors 'none'",
        }
    )
    return dataclasses.replace(page, headers=headers, body=body)

"""viser's own server. It accepts only connections of the page server, which checks what browsers send."""

import contextlib
import secrets
import time
import uuid
from collections.abc import Iterator
from typing import Any

import viser
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from snakesim_operator.base.console_port import LOOPBACK
from snakesim_operator.features.console.web.admission import ControlAdmission
from snakesim_operator.features.console.web.browser import BrowserConnection
from snakesim_operator.features.console.web.pacing import ask_page, pace_pages

ANY_FREE_PORT = 0
PASSWORD_BYTES = 32


class PageServer(viser.ViserServer):
    """viser's server, without its tunnel to the public internet, which any viewer could open.

    It listens on a port of loopback, because it has no option to listen elsewhere. Other programs of this computer can
    find that port. So the page server uses a new random path for each connection, and all others are closed unread.

    viser counts only pages that can draw the scene; this server knows all of them by their connections.
    """

    def __init__(self, admission: ControlAdmission) -> None:
        """Start to listen."""
        super().__init__(LOOPBACK, ANY_FREE_PORT, label="SnakeSIM", verbose=False)
        self.admission = admission
        # By the path of the connection that the page server opens for it.
        self._expected: dict[str, BrowserConnection] = {}
        self._browsers: dict[int, BrowserConnection] = {}  # by viewer
        self._websock_server.on_client_connect(self._check_connection)
        self._websock_server.on_client_disconnect(self._on_viewer_gone)
        self._websock_server.disconnect_all_clients()  # which connected before they were checked
        pace_pages(self)

    @contextlib.contextmanager
    def expect_browser(self, browser: BrowserConnection) -> Iterator[str]:
        """Accept one connection for a browser while the context lasts, and yield the address to connect to."""
        path = f"/{secrets.token_urlsafe(PASSWORD_BYTES)}"
        self._expected[path] = browser
        try:
            yield f"ws://{LOOPBACK}:{self.get_port()}{path}"
        finally:
            self._expected.pop(path, None)

    async def _check_connection(self, client: Any) -> None:
        """Number the browser of a connection, before any of its messages is read. Close a connection without one."""
        connection = self._websock_server._live_connections[client.client_id]
        browser = self._expected.pop(_get_request_path(connection), None)
        if browser is None:
            self.admission.count_dropped_message(
                None, "not of the page server", "a connection to viser's own port was closed"
            )
            await _close_unread(connection)
            return
        self._browsers[client.client_id] = browser
        browser.note_number(client.client_id)

    def _on_viewer_gone(self, client: Any) -> None:
        self._browsers.pop(client.client_id, None)

    def prefers_dark(self, viewer_id: int) -> bool:
        """Return whether a viewer's browser was set to dark pages when it connected."""
        browser = self._browsers.get(viewer_id)
        return browser is not None and browser.prefers_dark

    def count_viewers(self) -> int:
        """Return how many pages are open, also of those that cannot draw the scene."""
        return len(self._browsers)

    def ask_for_age(self, viewer_id: int, robot_ns: int | None) -> None:
        """Send a viewer's page the next question by which the age of its messages is known.

        Args:
            viewer_id: The viewer to ask.
            robot_ns: The robot's time now, if it is known.
        """
        browser = self._browsers.get(viewer_id)
        page = self.get_clients().get(viewer_id)
        if browser is None or page is None or not browser.age.may_ask():
            return
        question = uuid.uuid4().hex
        browser.age.note_question(question, time.monotonic(), robot_ns)
        ask_page(page, question)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to open a tunnel."""
        return None


def _get_request_path(connection: ServerConnection) -> str:
    return "" if connection.request is None else connection.request.path


async def _close_unread(connection: ServerConnection) -> None:
    """Close a connection, and drop the messages that have arrived, which viser would read otherwise."""
    connection.transport.abort()
    with contextlib.suppress(ConnectionClosed):
        async for _ in connection:
            pass

"""Starts the servers of the console's page: viser on a port of its own, and in front of it the page server."""

import contextlib
import http.client
import io
import socket
from collections.abc import Callable, Iterator
from typing import Any

from snakesim_operator.base.console_port import LOOPBACK
from snakesim_operator.features.console.web.added_html import add_html
from snakesim_operator.features.console.web.admission import ControlAdmission
from snakesim_operator.features.console.web.page_server import AnswerRequest, BrowserRelay
from snakesim_operator.features.console.web.viser_server import PageServer

PAGE_TIMEOUT_S = 30.0  # for viser to serve its page, on a busy computer


@contextlib.contextmanager
def serve_pages(
    listening_socket: socket.socket,
    report: Callable[[str], None] = lambda _: None,
    answer_first: AnswerRequest = lambda _: None,
    *,
    has_stop: bool,
) -> Iterator[PageServer]:
    """Start viser and the page server, and stop them at the end of the `with` block.

    Args:
        listening_socket: The Unix socket at which the front server connects.
        report: Called with a line for the first dropped message of each kind.
        answer_first: Answers requests for other pages than the console's; returns None for an unknown page.
        has_stop: Whether there is a robot that can be stopped.
    """
    with _ignore_output():
        server = PageServer(ControlAdmission(report))
    page = add_html(_read_page(server.get_port()), has_stop=has_stop)
    with BrowserRelay(listening_socket, server, page, answer_first):
        try:
            yield server
        finally:
            with _ignore_output():
                server.stop()


def _read_page(port: int) -> bytes:
    """Return viser's page, from viser's own server. It is not compressed, so HTML can be added."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=PAGE_TIMEOUT_S)
    with contextlib.closing(connection):
        connection.request("GET", "/")
        return connection.getresponse().read()


def _ignore_output() -> contextlib.AbstractContextManager[Any]:
    """Drop what viser prints as it starts and stops."""
    return contextlib.redirect_stdout(io.StringIO())

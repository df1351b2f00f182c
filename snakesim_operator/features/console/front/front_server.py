"""Accepts the connections of browsers, answers the second stop, and passes all other requests on to the page server.

No number of connections can prevent a stop. A connection first waits until the head of its request is complete. The
number of waiting connections and their time are limited: of too many, the oldest one is closed. A connection that has
shown the console's token does not wait any more. A page keeps its connection to the stop, so a flood cannot close it.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Protocol

from snakesim_hal.base.workers import ErrorReport
from snakesim_operator.base.byte_relay import relay_bytes
from snakesim_operator.features.console.front.requests import (
    BadRequest,
    FrontRequest,
    check_head,
    read_head,
)
from snakesim_operator.features.console.front.waiting import Connection, WaitingConnections

STOP_PATH = "/stop"
REQUESTER = "a page's second stop"

# Limits. Together they need some 750 open files: a page needs two, and a closed connection is freed a little later.
MAX_WAITING = 256  # connections whose request is not complete; a browser opens some ahead of need
MAX_PAGES = 160  # connections to the page server; each page has one, and a few more while it loads
MAX_AT_STOP = 64  # connections that have shown the token, and request a stop or ask whether it is ready
HEAD_LIMIT_S = 10.0  # from the connection to the end of its request's head
KEEP_LIMIT_S = 90.0  # between two requests for the stop; a page sends one a second, in the background one a minute
BACKLOG = 1024  # connections that the kernel keeps until they are accepted; it may have a lower limit
MAX_ACCEPTED_AT_ONCE = 32  # then the requests that have arrived are read
POLL_S = 0.1  # how often old requests are closed, and the stop's self-test is started if it is due

REASONS = {
    200: "OK",
    308: "Permanent Redirect",
    400: "Bad Request",
    403: "Forbidden",
    405: "Method Not Allowed",
    503: "Service Unavailable",
}


class Readiness(Protocol):
    """The result of a self-test: whether a stop would reach the robot."""

    @property
    def ready(self) -> bool:
        """Whether a stop would reach the robot."""
        ...

    @property
    def text(self) -> str:
        """The same in words, with the reason if it would not."""
        ...


class StopPath(Protocol):
    """Stops the robot, and tests whether it could. None of its methods waits."""

    def request(self, requester: str) -> "Future[str]":
        """Stop the robot; the future gets the result in words, or an error."""
        ...

    def readiness(self) -> Readiness:
        """Return the result of the newest self-test."""
        ...

    def test_if_due(self) -> None:
        """Start a self-test, if it is time for one."""
        ...


class FrontServer:
    """Serves browsers until its `run` is ended."""

    def __init__(
        self,
        listening: socket.socket,
        pages_path: Path,
        token: str,
        stop: StopPath | None,
        report: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Prepare the server to which browsers connect. It accepts connections once `run` is called.

        It checks the token of each request, passes requests to the page server, and can stop the robot by itself.

        Args:
            listening: The socket at which browsers connect.
            pages_path: The Unix socket of the page server.
            token: The first part of the path in each address that is answered.
            stop: Stops the robot; None for a recording, where there is nothing to stop.
            report: Called with a line for the first request refused of each kind.
        """
        self._listening = listening
        self._pages_path = pages_path
        self._token = token
        self._stop = stop
        self._report = report
        self._reported: set[str] = set()
        self._errors = ErrorReport("console front")
        # Connections.
        self._waiting = WaitingConnections(MAX_WAITING, self._begin)
        self._tasks: set[asyncio.Task[None]] = set()  # of the connections that do not wait
        self._at_stop: set[asyncio.StreamWriter] = set()
        self._open_pages = 0

    async def run(self, ended: asyncio.Event) -> None:
        """Serve until the event is set."""
        loop = asyncio.get_running_loop()
        # asyncio uses its `backlog` also as the number of connections that it accepts at once.
        server = await loop.create_server(self._waiting.create, sock=self._listening, backlog=MAX_ACCEPTED_AT_ONCE)
        self._listening.listen(BACKLOG)
        try:
            while not ended.is_set():
                self._waiting.abort_older_than(HEAD_LIMIT_S)
                if self._stop is not None:
                    self._stop.test_if_due()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), POLL_S)
        finally:
            server.close()

    def _begin(self, head: bytes, connection: Connection) -> None:
        """Serve a connection whose first request is complete, in a task of its own."""
        task = asyncio.ensure_future(self._serve_connection(head, *connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve_connection(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection to its end. head: of its first request."""
        try:
            while await self._answer(head, reader, writer):
                head = await read_head(reader, KEEP_LIMIT_S)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client has gone, or did not send another request in time
        except Exception as error:  # noqa: BLE001 - this connection's outermost frame
            self._errors.write(error)
        finally:
            self._at_stop.discard(writer)
            writer.close()

    async def _answer(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer a request, and return whether another one may follow over the same connection."""
        request = check_head(head, self._token)
        if isinstance(request, BadRequest):
            self._report_once(request.kind, request.reason)
            _respond(writer, request.status, request.reason)
            return False
        if request.path == STOP_PATH:
            return await self._answer_stop_request(request.method, writer)
        if not request.path and not request.is_websocket:  # relative addresses in the page need the slash
            _respond(writer, 308, "", f"Location: /{self._token}/\r\n")
            return False
        await self._relay(request, reader, writer)
        return False

    def _report_once(self, kind: str, reason: str) -> None:
        """Report the first refusal of each kind."""
        if kind not in self._reported:
            self._reported.add(kind)
            self._report(f"refused a request: {kind}: {reason}; more are not reported")

    # --- the second stop -------------------------------------------------------------------------------------

    async def _answer_stop_request(self, method: str, writer: asyncio.StreamWriter) -> bool:
        """Answer `GET` with the readiness of the stop, and `POST` by stopping the robot.

        Args:
            method: Method of the HTTP request.
            writer: The connection, to which the answer is written.

        Returns:
            Whether the connection is kept for further requests.
        """
        if self._stop is None:
            _respond(writer, 503, "a recording has nothing to stop")
            return False
        if method == "POST":
            # Requested before connections are counted: their number limits only the answers.
            stopped = self._stop.request(REQUESTER)
            if not self._keep_at_stop(writer):
                _respond(writer, 503, "the robot is being stopped; too many ask at once to wait for the result")
                return False
            status, text = await _wait_for_result(stopped)
        elif method == "GET":
            readiness = self._stop.readiness()
            status = 200 if readiness.ready else 503
            text = readiness.text
        else:
            _respond(writer, 405, "use GET or POST")
            return False
        is_kept = self._keep_at_stop(writer)
        _respond(writer, status, text, is_kept=is_kept)
        return is_kept

    def _keep_at_stop(self, writer: asyncio.StreamWriter) -> bool:
        """Keep a connection for requests of the stop, and return whether there is room for it."""
        if len(self._at_stop) < MAX_AT_STOP:
            self._at_stop.add(writer)
        return writer in self._at_stop

    # --- pages -----------------------------------------------------------------------------------------------

    async def _relay(self, request: FrontRequest, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass a request on to the page server, and copy what follows until either side ends the connection."""
        if self._open_pages >= MAX_PAGES:
            reason = f"more than {MAX_PAGES} connections are open; close some pages"
            self._report_once("too many connections", reason)
            _respond(writer, 503, reason)
            return
        self._open_pages += 1
        try:
            await self._relay_to_pages(request.head, reader, writer)
        finally:
            self._open_pages -= 1

    async def _relay_to_pages(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass the head of a request to the page server, and copy bytes until either side ends the connection."""
        try:
            pages_reader, pages_writer = await asyncio.open_unix_connection(str(self._pages_path))
        except OSError as error:
            _respond(writer, 503, f"the console's pages do not answer: {error.strerror}; use snakesim estop to stop")
            return
        try:
            pages_writer.write(head)
            await relay_bytes((reader, writer), (pages_reader, pages_writer))
        finally:
            pages_writer.close()


async def _wait_for_result(stopped: "Future[str]") -> tuple[int, str]:
    """Wait for the result of a stop, and return it as status and text."""
    try:
        return 200, await asyncio.wrap_future(stopped)
    except Exception as error:  # noqa: BLE001 - whatever a stop raises is the answer to its request
        return 503, str(error) or type(error).__name__


def _respond(
    writer: asyncio.StreamWriter, status: int, text: str, more_headers: str = "", *, is_kept: bool = False
) -> None:
    """Answer a request. Does not wait: the answer is far shorter than what a connection can buffer."""
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\n"
        f"Connection: {'keep-alive' if is_kept else 'close'}\r\n{more_headers}\r\n"
    )
    writer.write(head.encode() + body)

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

from snakesim_hal.base.workers import ErrorReporter
from snakesim_operator.base.byte_relay import relay_bytes
from snakesim_operator.features.console.front.requests import (
    BadRequest,
    FrontRequest,
    parse_and_authorize_head,
    read_head,
)
from snakesim_operator.features.console.front.waiting import Connection, WaitingConnections

STOP_PATH = "/stop"
REQUESTER = "a page's second stop"

# Limits. Together they need some 750 open files: a page needs two, and a closed connection is freed a little later.
MAX_WAITING = 256  # connections whose request is not complete; a browser opens some ahead of need
MAX_PAGES = 160  # connections to the page server; each page has one, and a few more while it loads
# Connections that have shown the token, and request a stop or ask whether it is ready.
MAX_AT_STOP = 64
HEAD_TIMEOUT_S = 10.0  # from the connection to the end of its request's head
# Between two requests for the stop; a page sends one a second, in the background one a minute.
KEEP_ALIVE_TIMEOUT_S = 90.0
# Connections that the kernel keeps until they are accepted; it may have a lower limit.
BACKLOG = 1024
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


class SelfTestResult(Protocol):
    """The result of a self-test: whether a stop would reach the robot."""

    @property
    def is_ready(self) -> bool:
        """Whether a stop would reach the robot."""
        ...

    @property
    def text(self) -> str:
        """The same in words, with the reason if it would not."""
        ...


class StopPath(Protocol):
    """Stops the robot, and tests whether it could. None of its methods waits."""

    def request_stop(self, requester: str) -> "Future[str]":
        """Stop the robot; the future gets the result in words, or an error."""
        ...

    def check_readiness(self) -> SelfTestResult:
        """Return the result of the newest self-test."""
        ...

    def start_self_test_if_due(self) -> None:
        """Start a self-test, if it is time for one."""
        ...


class FrontServer:
    """Serves browsers until its `run` is ended."""

    def __init__(
        self,
        listening_socket: socket.socket,
        pages_path: Path,
        console_token: str,
        stop: StopPath | None,
        report: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Prepare the server to which browsers connect; it accepts connections once `run` is called.

        The server checks the token of each request, passes requests to the page server, and can stop the robot without
        the page server.

        Args:
            listening_socket: The socket at which browsers connect.
            pages_path: The Unix socket of the page server.
            console_token: Secret that is the first part of the path in each address that is answered.
            stop: Stops the robot; None for a recording, which has no robot to stop.
            report: Called with a line for the first request refused of each kind.
        """
        self._listening_socket = listening_socket
        self._pages_path = pages_path
        self._token = console_token
        self._stop = stop
        self._report = report
        self._reported_kinds: set[str] = set()
        self._error_report = ErrorReporter("console front")
        # Connections.
        self._waiting_connections = WaitingConnections(MAX_WAITING, self._start_serving)
        self._tasks: set[asyncio.Task[None]] = set()  # of the connections that do not wait
        self._stop_connections: set[asyncio.StreamWriter] = set()
        self._open_page_count = 0

    async def run(self, ended: asyncio.Event) -> None:
        """Serve until the event is set."""
        loop = asyncio.get_running_loop()
        # asyncio uses its `backlog` also as the number of connections that it accepts at once.
        server = await loop.create_server(
            self._waiting_connections.create,
            sock=self._listening_socket,
            backlog=MAX_ACCEPTED_AT_ONCE,
        )
        self._listening_socket.listen(BACKLOG)
        try:
            while not ended.is_set():
                self._waiting_connections.abort_older_than(HEAD_TIMEOUT_S)
                if self._stop is not None:
                    self._stop.start_self_test_if_due()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), POLL_S)
        finally:
            server.close()

    def _start_serving(self, head: bytes, connection: Connection) -> None:
        """Serve a connection whose first request is complete, in a task of its own."""
        task = asyncio.ensure_future(self._serve_connection(head, *connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve_connection(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Serve one connection to its end. `head` is the head of its first request."""
        try:
            while await self._answer_request(head, reader, writer):
                head = await read_head(reader, KEEP_ALIVE_TIMEOUT_S)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client has gone, or did not send another request in time
        except Exception as error:  # noqa: BLE001 - this connection's outermost frame
            self._error_report.print_error(error)
        finally:
            self._stop_connections.discard(writer)
            writer.close()

    async def _answer_request(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bool:
        """Answer a request, and return whether another one may follow over the same connection."""
        request = parse_and_authorize_head(head, self._token)
        if isinstance(request, BadRequest):
            self._report_once(request.kind, request.reason)
            _write_response(writer, request.status, request.reason)
            return False
        if request.path == STOP_PATH:
            return await self._answer_stop_request(request.method, writer)
        # Relative addresses in the page need the slash.
        if not request.path and not request.is_websocket:
            _write_response(writer, 308, "", f"Location: /{self._token}/\r\n")
            return False
        await self._relay_request(request, reader, writer)
        return False

    def _report_once(self, kind: str, reason: str) -> None:
        """Report the first refusal of each kind."""
        if kind not in self._reported_kinds:
            self._reported_kinds.add(kind)
            self._report(f"refused a request: {kind}: {reason}; more are not reported")

    # --- the second stop -------------------------------------------------------------------------------------

    async def _answer_stop_request(self, method: str, writer: asyncio.StreamWriter) -> bool:
        """Answer a request for the stop: `GET` with the readiness of the stop, `POST` by stopping the robot.

        Args:
            method: Method of the HTTP request.
            writer: The connection, to which the answer is written.

        Returns:
            Whether the connection is kept open for further requests.
        """
        if self._stop is None:
            _write_response(writer, 503, "a recording has nothing to stop")
            return False
        if method == "POST":
            # Requested before connections are counted: their number limits only the answers.
            stop_result = self._stop.request_stop(REQUESTER)
            if not self._keep_stop_connection(writer):
                _write_response(
                    writer,
                    503,
                    "the robot is being stopped; too many ask at once to wait for the result",
                )
                return False
            status, text = await _wait_for_result(stop_result)
        elif method == "GET":
            readiness = self._stop.check_readiness()
            status = 200 if readiness.is_ready else 503
            text = readiness.text
        else:
            _write_response(writer, 405, "use GET or POST")
            return False
        is_kept = self._keep_stop_connection(writer)
        _write_response(writer, status, text, is_kept=is_kept)
        return is_kept

    def _keep_stop_connection(self, writer: asyncio.StreamWriter) -> bool:
        """Keep a connection for requests of the stop, and return whether there is room for it."""
        if len(self._stop_connections) < MAX_AT_STOP:
            self._stop_connections.add(writer)
        return writer in self._stop_connections

    # --- pages -----------------------------------------------------------------------------------------------

    async def _relay_request(
        self, request: FrontRequest, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Pass a request on to the page server, and copy what follows until either side ends the connection."""
        if self._open_page_count >= MAX_PAGES:
            reason = f"more than {MAX_PAGES} connections are open; close some pages"
            self._report_once("too many connections", reason)
            _write_response(writer, 503, reason)
            return
        self._open_page_count += 1
        try:
            await self._relay_to_pages(request.head, reader, writer)
        finally:
            self._open_page_count -= 1

    async def _relay_to_pages(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Pass the head of a request to the page server, and copy bytes until either side ends the connection."""
        try:
            pages_reader, pages_writer = await asyncio.open_unix_connection(str(self._pages_path))
        except OSError as error:
            _write_response(
                writer,
                503,
                f"the console's pages do not answer: {error.strerror}; use snakesim estop to stop",
            )
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


def _write_response(
    writer: asyncio.StreamWriter,
    status: int,
    text: str,
    more_headers: str = "",
    *,
    is_kept: bool = False,
) -> None:
    """Answer a request. Does not wait: the answer is far shorter than what a connection can buffer."""
    body = text.encode()
    head = (
        f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: text/plain; charset=utf-8\r\n"
        f"Content-Length: {len(body)}\r\nCache-Control: no-store\r\n"
        f"Connection: {'keep-alive' if is_kept else 'close'}\r\n{more_headers}\r\n"
    )
    writer.write(head.encode() + body)

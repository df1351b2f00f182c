"""Offers services of the ROS node. Each service answers one request at a time, in order, in a thread of its own.

An answer of the robot may take seconds. The bridge's loop continues meanwhile, and a stop request waits only for
earlier stop requests.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.base.workers import ErrorReporter
from snakesim_hal.network.foreign_network import RawQuery, RawQueryable
from snakesim_operator.features.ros2.graph import RosNode, RosTopic, make_reply_attachment
from snakesim_operator.features.ros2.service_types import RosService

RequestHandler = Callable[[Any], bytes]  # from a request to a response in CDR
MAX_REQUEST_BYTES = 65536


def _accept_any_request(_attachment: bytes) -> str:
    return ""


class ServiceServer:
    """Answers the requests of one service."""

    def __init__(
        self,
        node: RosNode,
        name: str,
        service: RosService,
        answer: RequestHandler,
        depth: int = 10,
        *,
        make_refusal: Callable[[str], bytes] | None = None,
        explain_refusal: Callable[[bytes], str] = _accept_any_request,
    ) -> None:
        """Declare a service in the ROS graph, whose requests are answered in a thread of its own.

        Args:
            node: The node that offers it.
            name: Name of the service, with its namespace.
            service: Type of the service.
            answer: Makes the response to a request, in the thread of this service.
            depth: Depth of the request queue, as the rmw profile of the service has it.
            make_refusal: Makes the response that states a reason for refusal; None if the type has no such response.
            explain_refusal: Returns why a request with this attachment is refused; empty if the request is allowed.
        """
        self.name = name
        self._service = service
        self._handle_request = answer
        self._make_refusal = make_refusal
        self._find_refusal_reason = explain_refusal
        self._request_queue: RawQueryable = node.declare_service(
            RosTopic(name, service.type, depth=depth)
        )
        self._executor = ThreadPoolExecutor(1)
        self._running_request: Future[None] | None = None  # the request that is being answered
        self._error_report = ErrorReporter(name)
        self.rejected_count = 0  # malformed requests

    def start_next_request(self, print_text: PrintLine) -> None:
        """Start to handle the next request in the service's thread, if the previous one is done; return at once.

        Args:
            print_text: Reports a request whose handler failed.
        """
        if self._running_request is not None:
            if not self._running_request.done():
                return
            error = self._running_request.exception()
            if error is not None:
                print_text(f"{self.name} was not answered: {error}")
            self._running_request = None
        query = self._request_queue.pop_oldest_query()
        if query is None:
            return
        # A request that cannot be answered or decoded is counted and dropped.
        reply_attachment = make_reply_attachment(query.attachment)
        request = self._decode_request(query.payload)
        if reply_attachment is None or request is None:
            self.rejected_count += 1
            return
        self._running_request = self._executor.submit(
            self._send_response, query, request, reply_attachment
        )

    def close(self) -> None:
        """Wait until the running request is answered, and drop the others."""
        self._executor.shutdown(cancel_futures=True)

    def _decode_request(self, payload: bytes) -> Any | None:
        if len(payload) > MAX_REQUEST_BYTES:
            return None
        return self._service.decode_request(payload)

    def _send_response(self, query: RawQuery, request: Any, reply_attachment: bytes) -> None:
        """Send the response to a request; it runs in the thread of this service."""
        response = self._make_response(request, query.attachment)
        query.reply(response, reply_attachment)

    def _make_response(self, request: Any, attachment: bytes) -> bytes:
        """Return the response to a request: an answer, or a refusal.

        An unexpected error becomes a refusal too, if the type of the service has one, because the client waits for a
        response.
        """
        reason = self._find_refusal_reason(attachment)
        if reason and self._make_refusal is not None:
            return self._make_refusal(reason)
        try:
            return self._handle_request(request)
        except Exception as error:
            if self._make_refusal is None:
                raise
            self._error_report.print_error(error)
            return self._make_refusal(f"unexpected error: {type(error).__name__}: {error}")


def run_action(action: Callable[[], str]) -> tuple[bool, str]:
    """Run an action for a response: return whether it succeeded, and its text or that of its error."""
    try:
        return True, action()
    except SnakesimError as error:
        return False, str(error)

"""Offers services of the ROS node. Each service answers one request at a time, in order, in a thread of its own.

An answer of the robot may take seconds. The bridge's loop continues meanwhile, and a stop request waits only for
earlier stop requests.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.base.workers import ErrorReport
from snakesim_hal.network.foreign_network import RawQuery, RawQueryable
from snakesim_operator.features.ros2.graph import Node, Topic, make_reply_attachment
from snakesim_operator.features.ros2.service_types import RosService

Answer = Callable[[Any], bytes]  # from a request to a response in CDR
MAX_REQUEST_BYTES = 65536


def _allow_any(_attachment: bytes) -> str:
    return ""


class ServiceServer:
    """Answers the requests of one service."""

    def __init__(
        self,
        node: Node,
        name: str,
        service: RosService,
        answer: Answer,
        depth: int = 10,
        *,
        make_refusal: Callable[[str], bytes] | None = None,
        explain_refusal: Callable[[bytes], str] = _allow_any,
    ) -> None:
        """Declare a service in the ROS graph, whose requests are answered in a thread of its own.

        Args:
            node: The node that offers it.
            name: Name of the service, with its namespace.
            service: Type of the service.
            answer: Makes the response to a request, in the thread of this service.
            depth: Depth of its queue, as the rmw profile of its kind has it.
            make_refusal: Makes the response that states a reason for refusal; None if its type has no such response.
            explain_refusal: Returns why a request with this attachment is refused; empty if it is allowed.
        """
        self.name = name
        self._service = service
        self._answer = answer
        self._make_refusal = make_refusal
        self._explain_refusal = explain_refusal
        self._requests: RawQueryable = node.declare_service(Topic(name, service.type, depth=depth))
        self._thread = ThreadPoolExecutor(1)
        self._running: Future[None] | None = None  # the request that is being answered
        self._errors = ErrorReport(name)
        self.rejected = 0  # malformed requests

    def poll(self, print_text: PrintLine) -> None:
        """Start to answer the next request, if the previous one has been answered. It does not wait."""
        if self._running is not None:
            if not self._running.done():
                return
            error = self._running.exception()
            if error is not None:
                print_text(f"{self.name} was not answered: {error}")
            self._running = None
        question = self._requests.take_next()
        if question is None:
            return
        reply_attachment = make_reply_attachment(question.attachment)
        request = self._decode(question.payload)
        if reply_attachment is None or request is None:
            self.rejected += 1
            return
        self._running = self._thread.submit(self._reply, question, request, reply_attachment)

    def close(self) -> None:
        """Wait until the running request is answered, and drop the others."""
        self._thread.shutdown(cancel_futures=True)

    def _decode(self, payload: bytes) -> Any | None:
        if len(payload) > MAX_REQUEST_BYTES:
            return None
        return self._service.decode_request(payload)

    def _reply(self, question: RawQuery, request: Any, reply_attachment: bytes) -> None:
        """Send the response to a request; it runs in the thread of this service."""
        response = self._respond(request, question.attachment)
        question.reply(response, reply_attachment)

    def _respond(self, request: Any, attachment: bytes) -> bytes:
        """Return the response to a request: an answer, or a refusal.

        An unexpected error becomes a refusal too, if the type of the service has one, because the client waits for a
        response.
        """
        reason = self._explain_refusal(attachment)
        if reason and self._make_refusal is not None:
            return self._make_refusal(reason)
        try:
            return self._answer(request)
        except Exception as error:
            if self._make_refusal is None:
                raise
            self._errors.write(error)
            return self._make_refusal(f"unexpected error: {type(error).__name__}: {error}")


def run_action(action: Callable[[], str]) -> tuple[bool, str]:
    """Run an action for a response: return whether it succeeded, and its text or that of its error."""
    try:
        return True, action()
    except SnakesimError as error:
        return False, str(error)

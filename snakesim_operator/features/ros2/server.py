"""The services of the node: each request is answered in a thread of its own service, one at a time, in order.

What a robot answers may take seconds; the bridge's loop goes on meanwhile, and a stop waits for nothing but a stop.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.terminal import Say
from snakesim_hal.base.workers import ErrorReport
from snakesim_hal.network.foreign_network import RawQueryable, RawQuestion
from snakesim_operator.features.ros2.graph import Node, Topic, answering
from snakesim_operator.features.ros2.service_types import Service

Answer = Callable[[Any], bytes]  # from a request to a response in CDR
MAX_REQUEST_BYTES = 65536


class Server:
    """One service."""

    def __init__(
        self,
        node: Node,
        name: str,
        service: Service,
        answer: Answer,
        depth: int = 10,
        *,
        refuse: Callable[[str], bytes] | None = None,
        why_not: Callable[[bytes], str] = lambda _attachment: "",
    ) -> None:
        """Declare the service.

        Args:
            node: The node that offers it.
            name: Its name, with its namespace.
            service: Its type.
            answer: Makes the response to a request, in a thread of its own.
            depth: Of its queue, as the rmw profile of its kind has it.
            refuse: Makes the response that says why not; None: its type has none.
            why_not: Says why a request with this attachment is refused; empty when it is not.
        """
        self.name, self._service, self._answer = name, service, answer
        self._refuse, self._why_not = refuse, why_not
        self._waiting: RawQueryable = node.server(Topic(name, service.type, depth=depth))
        self._thread = ThreadPoolExecutor(1)
        self._answered: Future[None] | None = None
        self._errors = ErrorReport(name)
        self.rejected = 0  # requests that were none

    def turn(self, say: Say) -> None:
        """Begin to answer the next request, once the last one is answered."""
        if self._answered is not None:
            if not self._answered.done():
                return
            if (error := self._answered.exception()) is not None:
                say(f"{self.name} was not answered: {error}")
            self._answered = None
        question = self._waiting.next()
        if question is None:
            return
        attached = answering(question.attachment)
        request = self._service.request(question.payload) if len(question.payload) <= MAX_REQUEST_BYTES else None
        if attached is None or request is None:
            self.rejected += 1
            return
        self._answered = self._thread.submit(lambda: question.reply(self._respond(request, question), attached))

    def _respond(self, request: Any, question: RawQuestion) -> bytes:
        """The response. An unexpected error is one as well, where its type can say so: a client waits for it."""
        why_not = self._why_not(question.attachment)
        if why_not and self._refuse is not None:
            return self._refuse(why_not)
        try:
            return self._answer(request)
        except Exception as error:
            if self._refuse is None:
                raise
            self._errors.write(error)
            return self._refuse(f"unexpected error: {type(error).__name__}: {error}")

    def close(self) -> None:
        """Wait for what is being answered."""
        self._thread.shutdown(cancel_futures=True)


def told(act: Callable[[], str]) -> tuple[bool, str]:
    """What came of it, for a response: whether, and the text."""
    try:
        return True, act()
    except SnakesimError as error:
        return False, str(error)

"""The services of the node: each request is answered in a thread of its own service, one at a time, in order.

What a robot answers may take seconds; the bridge's loop goes on meanwhile, and a stop waits for nothing but a stop.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from snakesim_hal.errors import SnakesimError
from snakesim_hal.network.foreign_network import RawQueryable
from snakesim_hal.terminal import Say
from snakesim_operator.ros2.graph import Node, Topic, answering
from snakesim_operator.ros2.service_types import Service

Answer = Callable[[Any], bytes]  # from a request to a response in CDR
MAX_REQUEST_BYTES = 65536


class Server:
    """One service."""

    def __init__(self, node: Node, name: str, service: Service, answer: Answer, depth: int = 10) -> None:
        """depth: of its queue, as the rmw profile of its kind has it."""
        self.name, self._service, self._answer = name, service, answer
        self._waiting: RawQueryable = node.server(Topic(name, service.type, depth=depth))
        self._thread = ThreadPoolExecutor(1)
        self._answered: Future[None] | None = None
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
        self._answered = self._thread.submit(lambda: question.reply(self._answer(request), attached))

    def close(self) -> None:
        """Wait for what is being answered."""
        self._thread.shutdown(cancel_futures=True)


def told(act: Callable[[], str]) -> tuple[bool, str]:
    """What came of it, for a response: whether, and the text."""
    try:
        return True, act()
    except SnakesimError as error:
        return False, str(error)

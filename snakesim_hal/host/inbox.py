"""Input of the HAL host: queued by other threads, decoded and handed over in the host's own.

It has lanes, and a lower lane has priority: an emergency stop waits for nothing, and no number of lease
requests delays a command. Each lane is bounded, so a flood costs no memory and blocks no other lane.
"""

import time
import weakref
from collections.abc import Callable, Collection
from dataclasses import dataclass
from queue import Empty
from typing import Any, Protocol

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Arrival, Question, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import (
    Answer,
    Done,
    EstopRequest,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    SimulatorRequest,
)

STOPS, PRESENCE, SAMPLES, REQUESTS = range(4)  # lanes
LIMITS = (64, None, 4096, 64)  # presence is limited to known services, so that lane needs no bound

Request = LeaseRequest | LifecycleRequest | EstopRequest | SimulatorRequest
Reply = Callable[[Answer], None]


@dataclass(frozen=True)
class LocalRequest:
    """A request that did not come over Zenoh."""

    request: Request
    reply: Reply


class Receiver(Protocol):
    """Handles the input."""

    def take_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """A command, and its time of arrival."""
        ...

    def take_done(self, service: str, tick: int) -> None:
        """A service has completed a tick."""
        ...

    def presence_changed(self, service: str, present: bool) -> None:
        """A service's liveliness token has appeared or vanished."""
        ...

    def answer(self, request: Request, reply: Reply) -> None:
        """A request; reply once, from any thread."""
        ...

    def refuse(self, error: WireError) -> Answer:
        """A message cannot be decoded; returns the answer if it was a query."""
        ...


class Inbox:
    """Queues filled by other threads and emptied by the host."""

    def __init__(
        self,
        session: Session,
        receiver: Receiver,
        services: Collection[str],
        reply: Callable[[Question, Answer], None],
    ) -> None:
        """Declare all subscriptions of the host.

        Args:
            session: The host's session.
            receiver: Handles the input. It must live as long as anything is taken from this inbox.
            services: Services whose presence matters.
            reply: Answers a query.
        """
        # The receiver owns its inbox. A reference back that counts would keep a whole run in memory after its end.
        self._receiver: Receiver = weakref.proxy(receiver)
        self._reply = reply
        self._queue: Mailbox[Any] = Mailbox(LIMITS)
        self._command_decoder = Decoder(JointCommand)
        self._done_decoder = Decoder(Done)
        self._request_decoders: dict[str, Decoder[Any]] = {
            keys.LEASE: Decoder(LeaseRequest),
            keys.LIFECYCLE: Decoder(LifecycleRequest),
            keys.ESTOP: Decoder(EstopRequest),
            keys.SIMULATOR: Decoder(SimulatorRequest),
        }
        self._services = frozenset(services)
        self.dropped = 0
        session.on_urgent_arrival(keys.JOINT_COMMAND, self._put_sample)
        session.on_urgent_arrival(keys.DONE_ALL, self._put_sample)
        session.on_question(keys.ESTOP, self._put_stop)
        for key in (keys.LEASE, keys.LIFECYCLE, keys.SIMULATOR):
            session.on_question(key, self._put_request)
        session.on_alive(self._put_presence)

    def waiting(self) -> int:
        """Number of queued items."""
        return self._queue.qsize()

    def ask(self, request: Request, reply: Reply) -> None:
        """Put a request that did not come over Zenoh; from any thread."""
        self._queue.put(LocalRequest(request, reply), STOPS)

    def wait(self, timeout_s: float) -> None:
        """Until an item is there, at most so long."""
        self._queue.wait(timeout_s)

    def take(self, timeout_s: float) -> bool:
        """Handle the next item; False when none came in time."""
        try:
            item = self._queue.get(timeout=timeout_s)
        except Empty:
            return False
        self.handle(item)
        return True

    def take_until(self, monotonic_ns: int) -> None:
        """Handle all items that arrive until a point in time."""
        while (left_ns := monotonic_ns - time.monotonic_ns()) > 0 and self.take(left_ns * 1e-9):
            pass

    def take_all(self, limit_ns: float) -> None:
        """Handle queued items, for at most this long: the rest of a flood waits for the next tick."""
        stop_ns = time.monotonic_ns() + limit_ns
        for _ in range(self._queue.qsize()):
            if not self.take(0.0) or time.monotonic_ns() > stop_ns:
                return

    def handle(self, item: Any) -> None:
        """Decode one item, and hand it over."""
        receiver = self._receiver
        if isinstance(item, LocalRequest):
            receiver.answer(item.request, item.reply)
        elif isinstance(item, Question):
            self._answer(item)
        elif not isinstance(item, Arrival):
            receiver.presence_changed(*item)
        else:
            try:
                if item.key == keys.JOINT_COMMAND:
                    command = self._command_decoder.decode(item.payload, item.encoding)
                    receiver.take_command(command, item.monotonic_ns)
                else:
                    done = self._done_decoder.decode(item.payload, item.encoding)
                    receiver.take_done(keys.service_of(item.key), done.tick)
            except WireError as error:
                receiver.refuse(error)

    def _answer(self, question: Question) -> None:
        try:
            request = self._request_decoders[question.key].decode(question.payload, question.encoding)
        except WireError as error:
            self._reply(question, self._receiver.refuse(error))
        else:
            self._receiver.answer(request, lambda answer: self._reply(question, answer))

    # --- in Zenoh's threads ----------------------------------------------------------------------------------

    def _put_stop(self, question: Question) -> None:
        self._queue.put(question, STOPS)

    def _put_request(self, question: Question) -> None:
        self.dropped += self._queue.full(REQUESTS)  # the requester gets no answer, and may ask again
        self._queue.put(question, REQUESTS)

    def _put_sample(self, arrival: Arrival) -> None:
        self.dropped += self._queue.full(SAMPLES)
        self._queue.put(arrival, SAMPLES)

    def _put_presence(self, key: str, present: bool) -> None:
        service = keys.service_of(key)
        if service in self._services:
            self._queue.put((service, present), PRESENCE)

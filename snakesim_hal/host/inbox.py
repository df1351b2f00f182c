"""Input of the HAL host: other threads queue it, and the host's own thread decodes and handles it.

Each kind of input has a lane of its own. Emergency stops are handled first, and no number of lease requests delays a
command. Every lane is bounded, so a flood costs no memory and blocks no other lane.
"""

import time
import weakref
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from queue import Empty
from typing import Protocol

from snakesim_hal.base.errors import WireError
from snakesim_hal.host.request_handler import Reply, Request
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import Arrival, Query
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

# The lanes, the most urgent first.
STOPS = 0
PRESENCE = 1
SAMPLES = 2
REQUESTS = 3
LIMITS = (64, None, 4096, 64)  # presence comes from known services only, so its lane needs no bound

RequestDecoder = Decoder[LeaseRequest] | Decoder[LifecycleRequest] | Decoder[EstopRequest] | Decoder[SimulatorRequest]


class Receiver(Protocol):
    """Handles the input, in the host's thread."""

    def on_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """Handle a command that arrived at `monotonic_ns`."""
        ...

    def on_done(self, service: str, tick: int) -> None:
        """Handle the message that a service has completed a tick."""
        ...

    def on_presence(self, service: str, present: bool) -> None:
        """Handle that a service's liveliness token has appeared or vanished."""
        ...

    def on_request(self, request: Request, reply: Reply) -> None:
        """Handle a request, and reply once, from any thread."""
        ...

    def on_undecodable(self, error: WireError) -> Answer:
        """Count a message that cannot be decoded, and return the answer for the case that it was a query."""
        ...


class QueuedInput(Protocol):
    """One item of a lane."""

    def deliver(self, receiver: Receiver) -> None:
        """Decode the item and hand it to the receiver. Raises WireError."""
        ...


@dataclass(frozen=True)
class CommandArrival:
    """A joint command that came over Zenoh."""

    arrival: Arrival
    decoder: Decoder[JointCommand]

    def deliver(self, receiver: Receiver) -> None:
        # Not `arrival.decode`, whose message readers in this process share: one of them might change it.
        command = self.decoder.decode(self.arrival.payload, self.arrival.encoding)
        receiver.on_command(command, self.arrival.monotonic_ns)


@dataclass(frozen=True)
class _Done:
    arrival: Arrival
    decoder: Decoder[Done]

    def deliver(self, receiver: Receiver) -> None:
        done = self.arrival.decode(self.decoder)
        receiver.on_done(keys.parse_service(self.arrival.key), done.tick)


@dataclass(frozen=True)
class _Presence:
    service: str
    present: bool

    def deliver(self, receiver: Receiver) -> None:
        receiver.on_presence(self.service, self.present)


@dataclass(frozen=True)
class _LocalRequest:
    """A request that did not come over Zenoh."""

    request: Request
    reply: Reply

    def deliver(self, receiver: Receiver) -> None:
        receiver.on_request(self.request, self.reply)


@dataclass(frozen=True)
class _RemoteRequest:
    """A request that came over Zenoh."""

    query: Query
    decoder: RequestDecoder
    send_answer: Callable[[Query, Answer], None]

    def deliver(self, receiver: Receiver) -> None:
        try:
            request = self.decoder.decode(self.query.payload, self.query.encoding)
        except WireError as error:
            self.send_answer(self.query, receiver.on_undecodable(error))
        else:
            receiver.on_request(request, lambda answer: self.send_answer(self.query, answer))


class Inbox:
    """Lanes that other threads fill and the host empties."""

    def __init__(
        self,
        session: Session,
        receiver: Receiver,
        services: Collection[str],
        send_answer: Callable[[Query, Answer], None],
    ) -> None:
        """Declare all subscriptions of the host.

        Args:
            session: The host's session.
            receiver: Handles the input. It must live as long as anything is taken from this inbox.
            services: Services whose presence matters.
            send_answer: Answers a query.
        """
        # The receiver owns its inbox. A reference back that counts would keep a whole run in memory after its end.
        self._receiver: Receiver = weakref.proxy(receiver)
        self._services = frozenset(services)
        self._lanes: Mailbox[QueuedInput] = Mailbox(LIMITS)
        self.dropped = 0

        self._command_decoder = Decoder(JointCommand)
        self._done_decoder = Decoder(Done)
        self._send_answer = send_answer

        session.on_urgent_arrival(keys.JOINT_COMMAND, self._put_command)
        session.on_urgent_arrival(keys.DONE_ALL, self._put_done)
        session.on_query(keys.ESTOP, partial(self._put_stop, Decoder(EstopRequest)))
        session.on_query(keys.LEASE, partial(self._put_request, Decoder(LeaseRequest)))
        session.on_query(keys.LIFECYCLE, partial(self._put_request, Decoder(LifecycleRequest)))
        session.on_query(keys.SIMULATOR, partial(self._put_request, Decoder(SimulatorRequest)))
        session.on_alive(self._put_presence)

    def waiting(self) -> int:
        """Return the number of queued items."""
        return self._lanes.qsize()

    def put_local_request(self, request: Request, reply: Reply) -> None:
        """Queue a request that did not come over Zenoh, before all other input; from any thread."""
        self._lanes.put(_LocalRequest(request, reply), STOPS)

    def wait(self, timeout_s: float) -> None:
        """Wait until an item is queued, for at most `timeout_s`."""
        self._lanes.wait(timeout_s)

    def handle_next(self, timeout_s: float) -> bool:
        """Handle the next item. Returns False when none arrives in time."""
        try:
            item = self._lanes.get(timeout=timeout_s)
        except Empty:
            return False
        self.handle(item)
        return True

    def handle_until(self, monotonic_ns: int) -> None:
        """Handle all items that arrive until a point in time."""
        while (left_ns := monotonic_ns - time.monotonic_ns()) > 0 and self.handle_next(left_ns * 1e-9):
            pass

    def handle_queued(self, limit_ns: float) -> None:
        """Handle the items that are queued now, for at most `limit_ns`. The rest of a flood waits for the next tick."""
        stop_ns = time.monotonic_ns() + limit_ns
        for _ in range(self._lanes.qsize()):
            if not self.handle_next(0.0) or time.monotonic_ns() > stop_ns:
                return

    def handle(self, item: QueuedInput) -> None:
        """Decode one item and hand it over."""
        try:
            item.deliver(self._receiver)
        except WireError as error:
            self._receiver.on_undecodable(error)

    # --- in Zenoh's threads ----------------------------------------------------------------------------------

    def _put_command(self, arrival: Arrival) -> None:
        self._put_sample(CommandArrival(arrival, self._command_decoder))

    def _put_done(self, arrival: Arrival) -> None:
        self._put_sample(_Done(arrival, self._done_decoder))

    def _put_sample(self, item: QueuedInput) -> None:
        self.dropped += self._lanes.full(SAMPLES)
        self._lanes.put(item, SAMPLES)

    def _put_stop(self, decoder: Decoder[EstopRequest], query: Query) -> None:
        self._lanes.put(_RemoteRequest(query, decoder, self._send_answer), STOPS)

    def _put_request(self, decoder: RequestDecoder, query: Query) -> None:
        self.dropped += self._lanes.full(REQUESTS)  # the requester gets no answer, and may ask again
        self._lanes.put(_RemoteRequest(query, decoder, self._send_answer), REQUESTS)

    def _put_presence(self, key: str, present: bool) -> None:
        service = keys.parse_service(key)
        if service in self._services:
            self._lanes.put(_Presence(service, present), PRESENCE)

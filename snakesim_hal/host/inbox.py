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
from snakesim_hal.network.streams import IncomingQuery, ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageDecoder
from snakesim_hal.wire.messages import (
    Answer,
    EstopRequest,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    SimulatorRequest,
    TickDone,
)

# Indices of the lanes, the most urgent first.
STOP_LANE = 0
PRESENCE_LANE = 1
SAMPLES = 2
REQUESTS = 3
LIMITS = (64, None, 4096, 64)  # presence comes from known services only, so its lane needs no bound

RequestDecoder = (
    MessageDecoder[LeaseRequest]
    | MessageDecoder[LifecycleRequest]
    | MessageDecoder[EstopRequest]
    | MessageDecoder[SimulatorRequest]
)


class InputReceiver(Protocol):
    """Handles the input, in the host's thread."""

    def on_command(self, command: JointCommand, monotonic_ns: int) -> None:
        """Handle a command that arrived at `monotonic_ns`."""
        ...

    def on_tick_done(self, service: str, tick: int) -> None:
        """Handle the message that a service has completed a tick."""
        ...

    def on_service_presence(self, service: str, present: bool) -> None:
        """Handle that a service's liveliness token has appeared or vanished."""
        ...

    def on_request(self, request: Request, reply: Reply) -> None:
        """Execute a request, and reply once, from any thread."""
        ...

    def on_undecodable_message(self, error: WireError) -> Answer:
        """Count a message that cannot be decoded, and return the answer to send if the message was a query."""
        ...


class QueuedInput(Protocol):
    """One item of a lane."""

    def deliver(self, receiver: InputReceiver) -> None:
        """Decode the item and hand it to the receiver. Raises WireError."""
        ...


@dataclass(frozen=True)
class CommandArrival:
    """A joint command that arrived over Zenoh."""

    arrival: ReceivedSample
    decoder: MessageDecoder[JointCommand]

    def deliver(self, receiver: InputReceiver) -> None:
        # Not `arrival.decode`, whose message readers in this process share: one of them might change it.
        command = self.decoder.decode(self.arrival.payload, self.arrival.encoding)
        receiver.on_command(command, self.arrival.monotonic_ns)


@dataclass(frozen=True)
class _DoneArrival:
    arrival: ReceivedSample
    decoder: MessageDecoder[TickDone]

    def deliver(self, receiver: InputReceiver) -> None:
        done = self.arrival.decode(self.decoder)
        receiver.on_tick_done(keys.parse_service(self.arrival.key), done.tick)


@dataclass(frozen=True)
class _PresenceChange:
    service: str
    present: bool

    def deliver(self, receiver: InputReceiver) -> None:
        receiver.on_service_presence(self.service, self.present)


@dataclass(frozen=True)
class _LocalRequest:
    """A request that did not arrive over Zenoh."""

    request: Request
    reply: Reply

    def deliver(self, receiver: InputReceiver) -> None:
        receiver.on_request(self.request, self.reply)


@dataclass(frozen=True)
class _RemoteRequest:
    """A request that arrived over Zenoh."""

    query: IncomingQuery
    decoder: RequestDecoder
    send_answer: Callable[[IncomingQuery, Answer], None]

    def deliver(self, receiver: InputReceiver) -> None:
        try:
            request = self.decoder.decode(self.query.payload, self.query.encoding)
        except WireError as error:
            self.send_answer(self.query, receiver.on_undecodable_message(error))
        else:
            receiver.on_request(request, lambda answer: self.send_answer(self.query, answer))


class HostInbox:
    """Lanes that other threads fill and the host empties."""

    def __init__(
        self,
        session: Session,
        receiver: InputReceiver,
        services: Collection[str],
        send_answer: Callable[[IncomingQuery, Answer], None],
    ) -> None:
        """Declare all subscriptions and queryables of the host.

        Args:
            session: Session of the host.
            receiver: Object that handles the input. The inbox holds only a weak reference to it.
            services: Names of the services whose liveliness tokens are watched.
            send_answer: Function that sends the answer to a query.
        """
        # The receiver owns its inbox. A reference back that counts would keep a whole run in memory after its end.
        self._receiver: InputReceiver = weakref.proxy(receiver)
        self._services = frozenset(services)
        self._queue: Mailbox[QueuedInput] = Mailbox(LIMITS)
        self.dropped = 0

        self._command_decoder = MessageDecoder(JointCommand)
        self._done_decoder = MessageDecoder(TickDone)
        self._send_answer = send_answer

        session.on_urgent_arrival(keys.JOINT_COMMAND, self._queue_command)
        session.on_urgent_arrival(keys.DONE_ALL, self._queue_done)
        session.on_query(
            keys.ESTOP, partial(self._queue_stop_request, MessageDecoder(EstopRequest))
        )
        session.on_query(keys.LEASE, partial(self._queue_request, MessageDecoder(LeaseRequest)))
        session.on_query(
            keys.LIFECYCLE, partial(self._queue_request, MessageDecoder(LifecycleRequest))
        )
        session.on_query(
            keys.SIMULATOR, partial(self._queue_request, MessageDecoder(SimulatorRequest))
        )
        session.on_token_change(self._queue_presence)

    def waiting(self) -> int:
        """Return the number of queued items."""
        return self._queue.qsize()

    def put_local_request(self, request: Request, reply: Reply) -> None:
        """Queue a request that did not arrive over Zenoh, before all other input; from any thread."""
        self._queue.put(_LocalRequest(request, reply), STOP_LANE)

    def wait(self, timeout_s: float) -> None:
        """Wait until an item is queued, for at most `timeout_s`."""
        self._queue.wait(timeout_s)

    def handle_next_item(self, timeout_s: float) -> bool:
        """Handle the next item. Returns False when none arrives in time."""
        try:
            item = self._queue.get(timeout=timeout_s)
        except Empty:
            return False
        self.handle(item)
        return True

    def handle_until(self, monotonic_ns: int) -> None:
        """Handle items as they arrive, until a monotonic time."""
        while (remaining_ns := monotonic_ns - time.monotonic_ns()) > 0 and self.handle_next_item(
            remaining_ns * 1e-9
        ):
            pass

    def handle_queued(self, limit_ns: float) -> None:
        """Handle the items that are queued now. The rest of a flood waits for the next tick.

        Args:
            limit_ns: Maximum duration in ns.
        """
        deadline_ns = time.monotonic_ns() + limit_ns
        for _ in range(self._queue.qsize()):
            if not self.handle_next_item(0.0) or time.monotonic_ns() > deadline_ns:
                return

    def handle(self, item: QueuedInput) -> None:
        """Decode one item and pass it to the receiver. An item that cannot be decoded is counted."""
        try:
            item.deliver(self._receiver)
        except WireError as error:
            self._receiver.on_undecodable_message(error)

    # --- in Zenoh's threads ----------------------------------------------------------------------------------

    def _queue_command(self, arrival: ReceivedSample) -> None:
        self._queue_sample(CommandArrival(arrival, self._command_decoder))

    def _queue_done(self, arrival: ReceivedSample) -> None:
        self._queue_sample(_DoneArrival(arrival, self._done_decoder))

    def _queue_sample(self, item: QueuedInput) -> None:
        self.dropped += self._queue.is_full(SAMPLES)
        self._queue.put(item, SAMPLES)

    def _queue_stop_request(
        self, decoder: MessageDecoder[EstopRequest], query: IncomingQuery
    ) -> None:
        self._queue.put(_RemoteRequest(query, decoder, self._send_answer), STOP_LANE)

    def _queue_request(self, decoder: RequestDecoder, query: IncomingQuery) -> None:
        # The requester gets no answer, and may ask again.
        self.dropped += self._queue.is_full(REQUESTS)
        self._queue.put(_RemoteRequest(query, decoder, self._send_answer), REQUESTS)

    def _queue_presence(self, key: str, present: bool) -> None:
        service = keys.parse_service(key)
        if service in self._services:
            self._queue.put(_PresenceChange(service, present), PRESENCE_LANE)

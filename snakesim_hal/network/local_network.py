"""A network within one process: its sessions pass each other the bytes that Zenoh would carry.

A message has reached its readers when `put` returns, in the order of sending, and nothing is lost.

Threads: one thread makes every call, so callbacks run in the thread that publishes. A query therefore first runs the
part of the process that answers it. Only `LocalQuery.reply` may be called from another thread.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from queue import Empty
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Session, key_expressions_intersect
from snakesim_hal.network.streams import (
    READER_DEPTH,
    IncomingQuery,
    Publisher,
    ReceivedSample,
    SampleReader,
    get_reader_depth,
)
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import (
    EncodedMessage,
    MessageDecoder,
    MessageT,
    encode,
    format_encoding,
)
from snakesim_hal.wire.messages import Answer, Message

SampleHandler = Callable[[ReceivedSample], None]


class LocalArrival(ReceivedSample, frozen=True):
    """A sample that stays within this process, so that it is decoded once.

    Its readers share the message that the publisher's check has decoded, or else the one that the first reader decodes.
    So no reader may change a message. The host decodes commands anew: what moves motors is shared with no service.
    """

    decoded: dict[type[Message], Any] = msgspec.field(default_factory=dict[type[Message], Any])

    def decode(self, decoder: MessageDecoder[MessageT]) -> MessageT:
        message: MessageT | None = self.decoded.get(decoder.message)
        if message is None:
            message = super().decode(decoder)
            self.decoded[decoder.message] = message
        return message


class LocalNetwork:
    """Connects the sessions of one process. Create sessions with `session`."""

    def __init__(self) -> None:
        """Start without sessions."""
        self.run_responders: Callable[[], None] = lambda: None  # runs the parts that answer queries
        # Callbacks, each with the key or pattern that it is for.
        self.subscribers: list[tuple[str, SampleHandler]] = []
        self.queryables: list[tuple[str, Callable[[IncomingQuery], None]]] = []
        self.watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        # What sessions have published.
        self.tokens: list[str] = []
        self.latched: dict[str, ReceivedSample] = {}  # by key
        self._handlers: dict[str, list[SampleHandler]] = {}  # cache of `find_handlers`, by key

    def create_session(self) -> "LocalSession":
        """Return a new session."""
        return LocalSession(self)

    def close(self) -> None:
        """Drop the reference to the parts that answer queries, because they refer to this network."""
        self.run_responders = lambda: None

    def find_handlers(self, key: str) -> list[SampleHandler]:
        """Return the callbacks of all subscribers of a key."""
        handlers = self._handlers.get(key)
        if handlers is None:
            handlers = [
                handler
                for pattern, handler in self.subscribers
                if key_expressions_intersect(pattern, key)
            ]
            self._handlers[key] = handlers
        return handlers

    def subscribe(self, pattern: str, handler: SampleHandler) -> Callable[[], None]:
        """Call `handler` for all samples that are published from now on. Returns a function that ends it."""
        subscriber = (pattern, handler)
        self.subscribers.append(subscriber)
        self._handlers.clear()

        def unsubscribe() -> None:
            self.subscribers.remove(subscriber)
            self._handlers.clear()

        return unsubscribe

    def set_token(self, key: str, present: bool) -> None:
        """Add or remove a liveliness token, and call its watchers."""
        if present:
            self.tokens.append(key)
        else:
            self.tokens.remove(key)
        for pattern, handler in self.watchers:
            if key_expressions_intersect(pattern, key):
                handler(key, present)


@dataclass
class ZenohDeclaration:
    """A subscription, token or queryable of a session. Zenoh's own objects have the same method."""

    undeclare: Callable[[], None]


class LocalPublisher(Publisher[MessageT]):
    """Passes a checked message to the readers, besides its bytes, unless a fault is injected into its key."""

    def __init__(
        self,
        message: type[MessageT],
        send: Callable[[bytes], None],
        send_encoded: Callable[[EncodedMessage], None],
        has_subscriber: Callable[[], bool],
    ) -> None:
        """Wrap the functions of the network.

        Args:
            message: The type of its messages.
            send: Sends bytes as they are, bypassing any reroute.
            send_encoded: Sends bytes, together with the message that was decoded from them.
            has_subscriber: Returns whether the key has a subscriber now.
        """
        super().__init__(message, send, has_subscriber)
        self._send_encoded = send_encoded

    def put(self, message: MessageT, encoded: EncodedMessage | None = None) -> None:
        if encoded is None or self.is_rerouted:
            super().put(message, encoded)
        else:
            self._send_encoded(encoded)


class LocalReader(SampleReader[MessageT]):
    """Reads the newest samples of one key from a queue that its subscription fills."""

    def __init__(
        self,
        declared: ZenohDeclaration,
        arrivals: deque[ReceivedSample],
        message: type[MessageT],
        rejected: Any,
    ) -> None:
        super().__init__(declared, message, rejected)
        self._arrivals = arrivals

    def _pop_samples(self) -> list[ReceivedSample]:
        if not self._arrivals:
            return []
        arrived = list(self._arrivals)
        self._arrivals.clear()
        return arrived

    def _decode_sample(self, sample: ReceivedSample, decoder: MessageDecoder[MessageT]) -> MessageT:
        return sample.decode(decoder)


@dataclass
class LocalQuery:
    """A query that waits for answers."""

    queryable_count: int  # queryables that have received it
    answers: Mailbox[tuple[str, bytes, str]] = field(
        default_factory=Mailbox[tuple[str, bytes, str]]
    )

    def reply(self, key: str, payload: bytes, encoding: str) -> None:
        """Store an answer. May be called from any thread."""
        self.answers.put((key, payload, encoding))

    def drop(self) -> None:
        """Do nothing: there is no query of Zenoh to release."""

    def poll(self) -> Answer | None:
        """Return the next answer; None if there is none yet."""
        if self.answers.empty():
            return None
        _, payload, encoding = self.answers.get_nowait()
        return MessageDecoder(Answer).decode(payload, encoding)


class LocalSession(Session):
    """A session of a `LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__(None)
        self._network = network

    def declare_publisher(
        self, key: str, message: type[MessageT], *, lossless: bool = False
    ) -> Publisher[MessageT]:
        """Declare a publisher. It is lossless in any case."""
        return self._declare_publisher(key, message, latched=False)

    def declare_latched_publisher(self, key: str, message: type[MessageT]) -> Publisher[MessageT]:
        return self._declare_publisher(key, message, latched=True)

    def _declare_publisher(
        self, key: str, message: type[MessageT], *, latched: bool
    ) -> Publisher[MessageT]:
        network = self._network
        encoding = format_encoding(message)

        def deliver(arrival: LocalArrival) -> None:
            if latched:
                network.latched[key] = arrival
            for handler in network.find_handlers(key):
                handler(arrival)

        def send(payload: bytes) -> None:
            deliver(LocalArrival(key, payload, encoding, time.monotonic_ns()))

        def send_encoded(encoded: EncodedMessage) -> None:
            decoded: dict[type[Message], Any] = {type(encoded.decoded): encoded.decoded}
            deliver(LocalArrival(key, encoded.payload, encoding, time.monotonic_ns(), decoded))

        def has_subscribers() -> bool:
            return bool(network.find_handlers(key))

        return self._register_publisher(
            key, LocalPublisher(message, send, send_encoded, has_subscribers)
        )

    def declare_reader(
        self, key: str, message: type[MessageT], *, depth: int | None = None
    ) -> SampleReader[MessageT]:
        arrivals: deque[ReceivedSample] = deque(maxlen=depth or get_reader_depth(message))
        declared = self._subscribe(key, arrivals.append)
        return LocalReader(declared, arrivals, message, self.rejected)

    def declare_latched_reader(self, key: str, message: type[MessageT]) -> SampleReader[MessageT]:
        arrivals: deque[ReceivedSample] = deque(maxlen=READER_DEPTH)
        if key in self._network.latched:
            arrivals.append(self._network.latched[key])
        declared = self._subscribe(key, arrivals.append)
        return LocalReader(declared, arrivals, message, self.rejected)

    def on_arrival(self, key: str, handler: SampleHandler) -> None:
        """Call `handler` for every sample, in the publisher's thread."""
        self._subscribe(key, handler)

    on_urgent_arrival = on_arrival  # every sample arrives at once

    def on_latched_arrival(self, key: str, handler: SampleHandler) -> None:
        """Call `handler` as `on_arrival` does, and also for the values that were latched before."""
        for latched_key, arrival in list(self._network.latched.items()):
            if key_expressions_intersect(key, latched_key):
                handler(arrival)
        self._subscribe(key, handler)

    def on_query(self, key: str, handler: Callable[[IncomingQuery], None]) -> None:
        """Call `handler` for every query, in the thread of the session that sends it."""
        queryable = (key, handler)
        self._network.queryables.append(queryable)
        self._declare(lambda: self._network.queryables.remove(queryable))

    def declare_token(self, key: str) -> None:
        self._network.set_token(key, True)
        self._declare(lambda: self._network.set_token(key, False))

    def on_token_change(
        self, handler: Callable[[str, bool], None], key: str = keys.ALIVE_ALL
    ) -> None:
        """Call `handler(key, present)` for every token that exists, appears or vanishes, in the declaring thread."""
        watcher = (key, handler)
        self._network.watchers.append(watcher)
        self._declare(lambda: self._network.watchers.remove(watcher))
        for token in self._network.tokens:
            if key_expressions_intersect(key, token):
                handler(token, True)

    def close(self) -> None:
        """Undeclare everything."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()

    def _subscribe(self, key: str, handler: SampleHandler) -> ZenohDeclaration:
        return self._declare(self._network.subscribe(key, handler))

    def _declare(self, undeclare: Callable[[], None]) -> ZenohDeclaration:
        declared = ZenohDeclaration(undeclare)
        self._declared.append(declared)
        return declared

    def send_query(self, pattern: str, request: Message) -> LocalQuery:
        """Send a query to all matching keys, without waiting: the answering part may have to run a cycle first."""
        matching = [
            (key, handler)
            for key, handler in self._network.queryables
            if key_expressions_intersect(pattern, key)
        ]
        query = LocalQuery(len(matching))
        for key, handler in matching:
            handler(IncomingQuery(key, encode(request), format_encoding(type(request)), query))
        return query

    def _iterate_answers(
        self,
        pattern: str,
        request: Message,
        timeout_s: float,
        priority: object = None,
    ) -> Iterator[tuple[str, Answer | WireError]]:
        """Send a request to all matching keys, and yield the answers. Messages in a process are delivered in order."""
        decoder = MessageDecoder(Answer)
        query = self.send_query(pattern, request)
        self._network.run_responders()
        deadline = time.monotonic() + timeout_s
        for _ in range(query.queryable_count):
            try:
                key, payload, encoding = query.answers.get(deadline - time.monotonic())
            except Empty:
                return
            yield key, decoder.decode(payload, encoding)

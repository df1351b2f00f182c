"""A network within one process: sessions that hand each other the bytes that Zenoh would carry, in the same thread.

A message has reached its readers when `put` returns; the order is kept, and nothing is lost. A query first runs the
one that answers it (`LocalNetwork.answer`), because both are in the same thread.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from queue import Empty
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import (
    READER_DEPTH,
    Arrival,
    Publisher,
    Question,
    Reader,
    Session,
    depth_of,
    intersects,
)
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, MessageT, encode, encoding_of
from snakesim_hal.wire.messages import Answer, Message

Take = Callable[[Arrival], None]


class LocalNetwork:
    """Where the sessions of one process meet."""

    def __init__(self) -> None:
        self.answer: Callable[[], None] = lambda: None  # runs the parts that answer queries
        self.subscribers: list[tuple[str, Take]] = []
        self.askable: list[tuple[str, Callable[[Question], None]]] = []
        self.watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self.tokens: list[str] = []
        self.latched: dict[str, Arrival] = {}
        self._takers: dict[str, list[Take]] = {}  # by key, as `subscribers` says

    def session(self) -> "LocalSession":
        """A new session."""
        return LocalSession(self)

    def close(self) -> None:
        """Let go of the parts that answered queries; they hold this network."""
        self.answer = lambda: None

    def takers(self, key: str) -> list[Take]:
        """The subscribers of a key."""
        found = self._takers.get(key)
        if found is None:
            found = self._takers[key] = [take for pattern, take in self.subscribers if intersects(pattern, key)]
        return found

    def subscribe(self, pattern: str, take: Take) -> Callable[[], None]:
        """Call `take` for what is published from now on. Returns a function that ends it."""
        row = pattern, take
        self.subscribers.append(row)
        self._takers.clear()

        def end() -> None:
            self.subscribers.remove(row)
            self._takers.clear()

        return end

    def show(self, key: str, present: bool) -> None:
        """A liveliness token comes or goes."""
        (self.tokens.append if present else self.tokens.remove)(key)
        for pattern, take in self.watchers:
            if intersects(pattern, key):
                take(key, present)


@dataclass
class Declared:
    """What a session has declared; Zenoh's own have this method too."""

    undeclare: Callable[[], None]


class LocalReader(Reader[MessageT]):
    """The newest samples of one key."""

    def __init__(self, declared: Declared, kept: deque[Arrival], message: type[MessageT], rejected: Any) -> None:
        super().__init__(declared, message, rejected)
        self._kept = kept

    def _take_samples(self) -> list[Arrival]:
        arrived = list(self._kept)
        self._kept.clear()
        return arrived

    def _content(self, sample: Arrival) -> tuple[bytes, str]:
        return sample.payload, sample.encoding


@dataclass
class LocalQuery:
    """Takes the answer to a question."""

    asked: int  # how many have been asked
    answers: Mailbox[tuple[str, bytes, str]] = field(default_factory=Mailbox[tuple[str, bytes, str]])

    def reply(self, key: str, payload: bytes, encoding: str) -> None:
        """From any thread."""
        self.answers.put((key, payload, encoding))

    def drop(self) -> None:
        """Nothing to let go of."""

    def answered(self) -> Answer | None:
        """The next answer, if it is there."""
        if self.answers.empty():
            return None
        _, payload, encoding = self.answers.get_nowait()
        return Decoder(Answer).decode(payload, encoding)


class LocalSession(Session):
    """A session of a `LocalNetwork`."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__(None)
        self._network = network

    def publisher(self, key: str, message: type[MessageT], *, lossless: bool = False) -> Publisher[MessageT]:
        """Nothing is lost in either case."""
        return self._local_publisher(key, message, latched=False)

    def latched_publisher(self, key: str, message: type[MessageT]) -> Publisher[MessageT]:
        """A publisher whose last value is given to readers that come later."""
        return self._local_publisher(key, message, latched=True)

    def _local_publisher(self, key: str, message: type[MessageT], *, latched: bool) -> Publisher[MessageT]:
        network, encoding = self._network, encoding_of(message)

        def send(payload: bytes) -> None:
            arrival = Arrival(key, payload, encoding, time.monotonic_ns())
            if latched:
                network.latched[key] = arrival
            for take in network.takers(key):
                take(arrival)

        return self._register_publisher(key, Publisher(message, send, lambda: bool(network.takers(key))))

    def reader(self, key: str, message: type[MessageT], *, depth: int | None = None) -> Reader[MessageT]:
        """The newest `depth` samples of a stream."""
        kept: deque[Arrival] = deque(maxlen=depth or depth_of(message))
        return LocalReader(self._subscribe(key, kept.append), kept, message, self.rejected)

    def latched_reader(self, key: str, message: type[MessageT]) -> Reader[MessageT]:
        """Like `reader`, and it gets the value that was latched before it came."""
        kept: deque[Arrival] = deque(maxlen=READER_DEPTH)
        if key in self._network.latched:
            kept.append(self._network.latched[key])
        return LocalReader(self._subscribe(key, kept.append), kept, message, self.rejected)

    def on_arrival(self, key: str, take: Take) -> None:
        """Call `take` for every sample."""
        self._subscribe(key, take)

    on_urgent_arrival = on_arrival  # all are at once

    def on_latched_arrival(self, key: str, take: Take) -> None:
        """Like `on_arrival`, and for the values that were latched before."""
        for at, arrival in list(self._network.latched.items()):
            if intersects(key, at):
                take(arrival)
        self._subscribe(key, take)

    def on_question(self, key: str, take: Callable[[Question], None]) -> None:
        """Call `take` for every query."""
        row = key, take
        self._network.askable.append(row)
        self._declare(lambda: self._network.askable.remove(row))

    def declare_token(self, key: str) -> None:
        """Show a liveliness token for as long as the session lives."""
        self._network.show(key, True)
        self._declare(lambda: self._network.show(key, False))

    def on_alive(self, take: Callable[[str, bool], None], key: str = keys.ALIVE_ALL) -> None:
        """Call `take(key, present)` for every token that is there, comes or goes."""
        row = key, take
        self._network.watchers.append(row)
        self._declare(lambda: self._network.watchers.remove(row))
        for token in self._network.tokens:
            if intersects(key, token):
                take(token, True)

    def close(self) -> None:
        """Undeclare everything."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()

    def _subscribe(self, key: str, take: Take) -> Declared:
        return self._declare(self._network.subscribe(key, take))

    def _declare(self, undeclare: Callable[[], None]) -> Declared:
        declared = Declared(undeclare)
        self._declared.append(declared)
        return declared

    def put_question(self, pattern: str, request: Message) -> LocalQuery:
        """Ask, without waiting: whoever answers may have to take a turn first."""
        asked = [(key, take) for key, take in self._network.askable if intersects(pattern, key)]
        query = LocalQuery(len(asked))
        for key, take in asked:
            take(Question(key, encode(request), encoding_of(type(request)), query))
        return query

    def _answers(self, pattern: str, request: Message, timeout_s: float) -> Iterator[tuple[str, Answer | WireError]]:
        query, decoder = self.put_question(pattern, request), Decoder(Answer)
        self._network.answer()
        deadline = time.monotonic() + timeout_s
        for _ in range(query.asked):
            try:
                key, payload, encoding = query.answers.get(deadline - time.monotonic())
            except Empty:
                return
            yield key, decoder.decode(payload, encoding)

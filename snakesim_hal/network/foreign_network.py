"""A second Zenoh network, with keys and payloads that are not ours: raw bytes with attachments, no namespace.

A bridge joins it as a client of an explicit endpoint. That network cannot delay the robot's own one: it is another
session, samples are dropped rather than waited for, and only the newest of each key stays.

Threads: the bridge's thread makes every call, except `RawReader.store`, which Zenoh's thread calls.
"""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.network.connection import ConnectionSettings, open_zenoh

MAX_WAITING_QUERIES = 10  # at one key, as rmw's profile of services has it
CONNECT_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class RawPublisher:
    """Publishes bytes on one key."""

    _zenoh_publisher: Any

    def send(self, payload: bytes, attachment: bytes) -> None:
        """Send a payload. It is dropped if the network is too slow for it."""
        self._zenoh_publisher.put(payload, attachment=attachment)

    def has_subscriber(self) -> bool:
        """Return whether the key has a subscriber now."""
        return bool(self._zenoh_publisher.matching_status.matching)


@dataclass(frozen=True)
class RawSample:
    """One sample, as it was sent."""

    payload: bytes
    attachment: bytes
    arrived_ns: int  # monotonic


class RawReader:
    """Keeps the newest samples of one key."""

    def __init__(self, depth: int) -> None:
        """Keep at most `depth` samples."""
        self._arrivals: deque[RawSample] = deque(maxlen=depth)

    def store(self, sample: zenoh.Sample) -> None:
        """Keep a sample, in Zenoh's thread."""
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self._arrivals.append(RawSample(sample.payload.to_bytes(), attachment, time.monotonic_ns()))

    def drain(self) -> list[RawSample]:
        """Return the samples that have arrived since the last call, oldest first."""
        samples: list[RawSample] = []
        while self._arrivals:
            samples.append(self._arrivals.popleft())
        return samples

    def pop_newest(self) -> RawSample | None:
        """Return the newest sample that has arrived since the last call; None if there is none."""
        samples = self.drain()
        return samples[-1] if samples else None


@dataclass(frozen=True)
class RawQuery:
    """A query that waits for one reply."""

    _query: Any
    payload: bytes
    attachment: bytes

    def reply(self, payload: bytes, attachment: bytes) -> None:
        """Send the reply on the key of the query."""
        with self._query as query:
            query.reply(query.key_expr, payload, attachment=attachment)


@dataclass(frozen=True)
class RawQueryable:
    """Receives the queries at one key."""

    _queryable: Any

    def pop_oldest_query(self) -> RawQuery | None:
        """Remove the oldest waiting query from the queue and return it; None if there is none."""
        query = self._queryable.try_recv()
        if query is None:
            return None
        payload = b"" if query.payload is None else query.payload.to_bytes()
        attachment = b"" if query.attachment is None else query.attachment.to_bytes()
        return RawQuery(query, payload, attachment)


class ForeignNetwork:
    """A session on the network of another system. Open one with `open_foreign_network`."""

    def __init__(self, zenoh_session: zenoh.Session) -> None:
        self._zenoh = zenoh_session
        self._declared: list[Any] = []
        self.id = str(zenoh_session.zid())

    def declare_publisher(
        self, key: str, *, latched: bool = False, background: bool = False
    ) -> RawPublisher:
        """Declare a publisher.

        Samples are dropped if the network is too slow for them. `close` undeclares the publisher.

        Args:
            key: Key to publish on.
            latched: Whether later subscribers get the last value.
            background: Whether its samples have the lowest priority, as images do.

        Returns:
            The publisher, which sends bytes.
        """
        priority = zenoh.Priority.BACKGROUND if background else zenoh.Priority.DATA
        if latched:
            # Dropping is the default of an advanced publisher, which has no argument for it.
            publisher: Any = ext.declare_advanced_publisher(
                self._zenoh,
                key,
                cache=ext.CacheConfig(1),
                publisher_detection=True,
                priority=priority,
            )
        else:
            congestion_control = zenoh.CongestionControl.DROP
            publisher = self._zenoh.declare_publisher(
                key, congestion_control=congestion_control, priority=priority
            )
        self._declared.append(publisher)
        return RawPublisher(publisher)

    def declare_queryable(self, key: str) -> RawQueryable:
        """Declare a receiver of queries at a key. If more than MAX_WAITING_QUERIES wait, the oldest are dropped."""
        queryable = self._zenoh.declare_queryable(
            key, handlers.RingChannel(MAX_WAITING_QUERIES), complete=True
        )
        self._declared.append(queryable)
        return RawQueryable(queryable)

    def declare_reader(self, key: str, depth: int = 1) -> RawReader:
        """Subscribe to a key, and keep its newest samples."""
        reader = RawReader(depth)
        self._declared.append(self._zenoh.declare_subscriber(key, reader.store))
        return reader

    def declare_token(self, key: str) -> None:
        """Declare a liveliness token for as long as the session lives."""
        self._declared.append(self._zenoh.liveliness().declare_token(key))

    def close(self) -> None:
        """Undeclare everything, then close."""
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()
        self._zenoh.close()


@contextmanager
def open_foreign_network(endpoint: str, *, max_bytes: int) -> Iterator[ForeignNetwork]:
    """Connect to a router of another system, and close the session when the context ends.

    Args:
        endpoint: Endpoint of the router.
        max_bytes: Maximum size of a received payload.

    Raises:
        NotConnectedError: The router does not answer.
    """
    session = open_zenoh(ConnectionSettings(endpoint, max_bytes=max_bytes), CONNECT_TIMEOUT_S)
    with closing(ForeignNetwork(session)) as network:
        yield network

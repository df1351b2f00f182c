"""A second Zenoh network, with keys and payloads that are not ours: raw bytes with attachments, no namespace.

A bridge joins it as a client of an explicit endpoint. Nothing that happens there can hold up the robot's own network:
it is another session, samples are dropped rather than waited for, and only the newest of each key is kept.
"""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Any

import zenoh
from zenoh import ext, handlers  # pyright: ignore[reportMissingModuleSource]

from snakesim_hal.network.connection import Link, open_zenoh

WAITING = 10  # queries at one key, as rmw's profile of services has it
CONNECT_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class RawPublisher:
    """Puts bytes on one key."""

    _publisher: Any

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Send it; dropped when the network is too slow for it."""
        self._publisher.put(payload, attachment=attachment)

    def heard(self) -> bool:
        """Whether anybody subscribes to it now."""
        return bool(self._publisher.matching_status.matching)


@dataclass(frozen=True)
class RawSample:
    """One sample, as it was sent."""

    payload: bytes
    attachment: bytes
    arrived_ns: int  # monotonic


class RawReader:
    """The newest samples of one key."""

    def __init__(self, depth: int) -> None:
        """depth: how many are kept."""
        self._kept: deque[RawSample] = deque(maxlen=depth)

    def take(self, sample: zenoh.Sample) -> None:
        """Keep one; in Zenoh's thread."""
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self._kept.append(RawSample(sample.payload.to_bytes(), attachment, time.monotonic_ns()))

    def drain(self) -> list[RawSample]:
        """What has arrived since the last call, as far as it is kept, oldest first."""
        found: list[RawSample] = []
        while self._kept:
            found.append(self._kept.popleft())
        return found

    def newest(self) -> RawSample | None:
        """The newest one that has arrived since the last call; None: nothing."""
        found = self.drain()
        return found[-1] if found else None


@dataclass(frozen=True)
class RawQuestion:
    """A query that waits for one reply."""

    _query: Any
    payload: bytes
    attachment: bytes

    def reply(self, payload: bytes, attachment: bytes) -> None:
        """Answer it at the key that was asked."""
        with self._query as query:
            query.reply(query.key_expr, payload, attachment=attachment)


@dataclass(frozen=True)
class RawQueryable:
    """The queries at one key."""

    _queryable: Any

    def next(self) -> RawQuestion | None:
        """The oldest one that waits; None: there is none."""
        query = self._queryable.try_recv()
        if query is None:
            return None
        payload, attachment = (b"" if part is None else part.to_bytes() for part in (query.payload, query.attachment))
        return RawQuestion(query, payload, attachment)


class ForeignNetwork:
    """A session on a network of somebody else. Open one with `open_foreign_network`."""

    def __init__(self, zenoh_session: zenoh.Session) -> None:
        self._zenoh = zenoh_session
        self._declared: list[Any] = []
        self.id = str(zenoh_session.zid())

    def publisher(self, key: str, *, latched: bool = False, background: bool = False) -> RawPublisher:
        """latched: later subscribers get the last value; background: after everything else, for images."""
        priority = zenoh.Priority.BACKGROUND if background else zenoh.Priority.DATA
        if latched:
            made: Any = ext.declare_advanced_publisher(
                self._zenoh, key, cache=ext.CacheConfig(1), publisher_detection=True, priority=priority
            )
        else:
            drop = zenoh.CongestionControl.DROP
            made = self._zenoh.declare_publisher(key, congestion_control=drop, priority=priority)
        self._declared.append(made)
        return RawPublisher(made)

    def queryable(self, key: str) -> RawQueryable:
        """The queries at a key, of which the newest wait."""
        queryable = self._zenoh.declare_queryable(key, handlers.RingChannel(WAITING), complete=True)
        self._declared.append(queryable)
        return RawQueryable(queryable)

    def reader(self, key: str, depth: int = 1) -> RawReader:
        """The newest samples of a key."""
        reader = RawReader(depth)
        self._declared.append(self._zenoh.declare_subscriber(key, reader.take))
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
    """Connect to a router. max_bytes: of a payload from there. Raises NotConnectedError."""
    session = open_zenoh(Link(endpoint, max_bytes=max_bytes), CONNECT_TIMEOUT_S)
    with closing(ForeignNetwork(session)) as network:
        yield network

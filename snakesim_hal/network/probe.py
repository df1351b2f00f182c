"""Measures a network without moving anything: round trips, clock offsets, and which keys answer."""

import statistics
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime

import zenoh

from snakesim_hal.base.errors import NotConnectedError

UNUSED_KEY = "nobody/is/here"
TRIES = 9


class Probe:
    """A session that only looks. Open one with `open_probe`."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def round_trip_s(self) -> float:
        """To the router and back, typically."""
        took: list[float] = []
        for _ in range(TRIES):
            began = time.perf_counter()
            list(self._session.liveliness().get(UNUSED_KEY, timeout=1.0))
            took.append(time.perf_counter() - began)
        return statistics.median(took)

    def answers(self, key: str, timeout_s: float = 1.0) -> int:
        """How many answer an empty query, which a HAL host refuses without any effect."""
        replies = self._session.get(key, timeout=timeout_s, target=zenoh.QueryTarget.ALL)
        return sum(reply.ok is not None for reply in replies)

    def clock_offsets_s(self, patterns: Sequence[str], listen_s: float) -> dict[str, float]:
        """By key, how far the clock of who publishes there is ahead of this computer's, in s.

        Zenoh stamps a sample where it is put. The way here takes time, so that the largest difference is nearest to the
        truth; it lacks the shortest way. Such a clock is never behind that of those whose samples it has read.
        """
        ahead: dict[str, list[float]] = defaultdict(list)

        def take(sample: zenoh.Sample) -> None:
            if sample.timestamp is not None:
                sent = sample.timestamp.get_time()
                ahead[str(sample.key_expr)].append((sent.astimezone(UTC) - datetime.now(UTC)).total_seconds())

        subscribers = [self._session.declare_subscriber(pattern, take) for pattern in patterns]
        time.sleep(listen_s)
        for subscriber in subscribers:
            subscriber.undeclare()
        return {key: max(differences) for key, differences in ahead.items()}


@contextmanager
def open_probe(settings: str) -> Iterator[Probe]:
    """Connect. settings: of a session, as JSON5. Raises NotConnectedError when no router accepts it."""
    zenoh.init_log_from_env_or("off")
    try:
        session = zenoh.open(zenoh.Config.from_json5(settings))
    except zenoh.ZError as error:
        raise NotConnectedError(str(error).split(" at /")[0]) from None
    with session:
        yield Probe(session)

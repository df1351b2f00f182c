"""Measures a network without moving anything: round trips, clock offsets, and which keys answer.

Threads: the caller's thread makes every call; samples arrive in Zenoh's threads while it waits.
"""

import statistics
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime

import zenoh

from snakesim_hal.base.errors import NotConnectedError

UNUSED_KEY = "unused/key"
ROUND_TRIP_COUNT = 9  # of which the median counts


class NetworkProbe:
    """A session that only measures. Open one with `open_probe`."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session

    def measure_round_trip_s(self) -> float:
        """Return the median duration of a query to the router and back, in s."""
        durations_s: list[float] = []
        for _ in range(ROUND_TRIP_COUNT):
            start_s = time.perf_counter()
            list(self._session.liveliness().get(UNUSED_KEY, timeout=1.0))
            durations_s.append(time.perf_counter() - start_s)
        return statistics.median(durations_s)

    def count_answers(self, key: str, timeout_s: float = 1.0) -> int:
        """Return how many processes answer an empty query, which a HAL host refuses without any effect."""
        replies = self._session.get(key, timeout=timeout_s, target=zenoh.QueryTarget.ALL)
        return sum(reply.ok is not None for reply in replies)

    def measure_clock_offsets_s(self, patterns: Sequence[str], listen_s: float) -> dict[str, float]:
        """Measure, for each key, how far the publisher's clock is ahead of this computer's clock.

        Zenoh timestamps samples at the publisher, so each difference is the clock offset minus the network latency.
        The maximum over many samples is the best estimate; it is too small by the minimum latency. The clock of such a
        timestamp is never behind the timestamps of samples that its process has read.

        Args:
            patterns: Keys to subscribe to. They may have wildcards.
            listen_s: Duration of the measurement, in s.

        Returns:
            The offset in s of each key on which a sample with a timestamp arrived.
        """
        offsets_s: dict[str, list[float]] = defaultdict(list)

        def add_offset(sample: zenoh.Sample) -> None:
            if sample.timestamp is not None:
                sent_time = sample.timestamp.get_time().astimezone(UTC)
                offset = sent_time - datetime.now(UTC)
                offsets_s[str(sample.key_expr)].append(offset.total_seconds())

        subscribers = [
            self._session.declare_subscriber(pattern, add_offset) for pattern in patterns
        ]
        time.sleep(listen_s)
        for subscriber in subscribers:
            subscriber.undeclare()
        return {key: max(offsets) for key, offsets in offsets_s.items()}


@contextmanager
def open_probe(settings: str) -> Iterator[NetworkProbe]:
    """Connect to a router to measure its network, and close the session when the context ends.

    Args:
        settings: Settings of a Zenoh session, as JSON5.

    Raises:
        NotConnectedError: No router accepts the session.
    """
    zenoh.init_log_from_env_or("off")
    try:
        session = zenoh.open(zenoh.Config.from_json5(settings))
    except zenoh.ZError as error:
        raise NotConnectedError(
            str(error).split(" at /")[0], code="network/nothing-listens"
        ) from None
    with session:
        yield NetworkProbe(session)

"""Floods or occupies the network of a robot, as a process of its own.

    python -m verification.attack.tools.flooder KIND ENDPOINT AMOUNT

KIND is a key of `KINDS`. The process prints "ready" when the flood has begun, and continues until it is killed or its
standard input is closed.
"""

import os
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import zenoh
from zenoh import handlers  # pyright: ignore[reportMissingModuleSource]

from verification.attack.client import NAMESPACE, make_zenoh_config
from verification.attack.tools import wire

REPORT_PERIOD_S = 1.0
MESSAGES_PER_REPORT = 1000
SMALL_BUFFER_BYTES = 4096
SUBSCRIBER_DELAY_S = 1.0  # until the robot's host knows all subscribers

# Key, payload and encoding of one query.
Query = tuple[str, bytes, str]
# Takes endpoint and amount, floods without end, and yields the lines to print.
Flooder = Callable[[str, int], Iterator[str]]


class _RateLimiter:
    """Limits how many messages are sent in a second."""

    def __init__(self, max_per_s: int) -> None:
        self._max_per_s = max_per_s
        self._start_s = time.monotonic()
        self.sent_count = 0

    def count_and_wait(self, new_count: int = 1) -> None:
        """Count sent messages, and sleep while they exceed the rate."""
        self.sent_count += new_count
        ahead_s = self.sent_count / self._max_per_s - self._elapsed_s()
        if ahead_s > 0:
            time.sleep(ahead_s)

    def measured_per_s(self) -> float:
        """Return the rate that this process reached so far."""
        return self.sent_count / self._elapsed_s()

    def _elapsed_s(self) -> float:
        return time.monotonic() - self._start_s


def occupy_sessions(endpoint: str, max_count: int) -> Iterator[str]:
    """Open up to `max_count` sessions that do nothing, or as many as the robot accepts."""
    sessions: list[zenoh.Session] = []
    while len(sessions) < max_count:
        try:
            sessions.append(zenoh.open(make_zenoh_config(endpoint, timeout_s=1.0)))
        except zenoh.ZError:
            break
    yield f"ready: {len(sessions)} sessions"
    while True:
        time.sleep(REPORT_PERIOD_S)
        yield f"{len(sessions)} sessions"


def request_leases(endpoint: str, max_per_s: int) -> Iterator[str]:
    """Send requests for the command lease, up to `max_per_s` in a second."""
    request = wire.encode({"action": "acquire", "holder": "flood", "priority": 0})
    query = ("hal/lease", request, wire.find_encoding("hal/lease"))
    yield from _send_queries(endpoint, max_per_s, [query])


def query_with_random_bytes(endpoint: str, max_per_s: int) -> Iterator[str]:
    """Send random bytes to every key that answers queries, up to `max_per_s` in a second."""
    generator = random.Random(1)
    queries = [
        (key.replace("*", "run"), generator.randbytes(200), wire.find_encoding(key))
        for key in wire.QUERY_KEYS
    ]
    yield from _send_queries(endpoint, max_per_s, queries)


def _send_queries(endpoint: str, max_per_s: int, queries: list[Query]) -> Iterator[str]:
    """Send all queries in turn without reading the answers."""
    session = zenoh.open(make_zenoh_config(endpoint))
    limiter = _RateLimiter(max_per_s)
    yield "ready"
    while True:
        for key, payload, encoding in queries:
            # An unread channel costs this process less than a callback.
            session.get(
                f"{NAMESPACE}/{key}",
                handlers.RingChannel(1),
                payload=payload,
                encoding=encoding,
                timeout=1.0,
            )
        limiter.count_and_wait(len(queries))
        if limiter.sent_count % MESSAGES_PER_REPORT < len(queries):
            yield f"{limiter.measured_per_s():.0f} queries a second"


def publish_garbage(endpoint: str, max_per_s: int) -> Iterator[str]:
    """Publish random bytes and well-formed but wrong messages on every key, up to `max_per_s` in a second."""
    generator = random.Random(1)
    session = zenoh.open(make_zenoh_config(endpoint))
    targets = [
        (f"{NAMESPACE}/{key}", wire.find_encoding(key))
        for key in (key.replace("*", "control") for key in wire.PUBLISHED_KEYS)
    ]
    payloads = [
        *(generator.randbytes(generator.choice((1, 30, 300, 3000))) for _ in range(50)),
        *(wire.make_nested_list_payload(depth) for depth in (10, 1000, 100_000)),
        *(wire.encode({"tick": tick, "timestamp_ns": 0}) for tick in (0, 2**62)),
        wire.encode({str(i): i for i in range(1000)}),
    ]
    limiter = _RateLimiter(max_per_s)
    while True:
        key, encoding = generator.choice(targets)
        session.put(key, generator.choice(payloads), encoding=encoding)
        limiter.count_and_wait()
        if limiter.sent_count == MESSAGES_PER_REPORT:
            yield "ready"
        elif limiter.sent_count % MESSAGES_PER_REPORT == 0:
            yield f"{limiter.measured_per_s():.0f} samples a second"


def subscribe_with_patterns(endpoint: str, count: int) -> Iterator[str]:
    """Declare subscribers whose patterns match every key. If this process is killed, all of them leave at once."""
    session = zenoh.open(make_zenoh_config(endpoint))
    subscribers: list[Any] = []
    for index in range(count):
        # An unread channel needs no thread.
        channel = handlers.RingChannel(1)
        subscribers.append(session.declare_subscriber(make_pattern(index), channel))
    time.sleep(SUBSCRIBER_DELAY_S)
    yield "ready"
    while True:
        time.sleep(REPORT_PERIOD_S)
        yield f"{len(subscribers)} subscribers"


def make_pattern(index: int) -> str:
    """Return a key expression that matches nearly every key of the robot.

    The indices below 1024 give 992 different ones.
    """
    namespace_bits = index % 256
    suffix = ("**", "*/**", "*/*", "*/*/**")[index // 256 % 4]
    letters = [
        letter if namespace_bits >> position & 1 else "$*"
        for position, letter in enumerate(NAMESPACE)
    ]
    namespace = "".join(letters)
    while "$*$*" in namespace:
        namespace = namespace.replace("$*$*", "$*")
    if namespace == "$*":
        namespace = "*"
    return f"{namespace}/{suffix}"


def subscribe_everything(endpoint: str, _amount: int) -> Iterator[str]:
    """Subscribe to every key. A test can freeze this process; its small buffer is then full at once."""
    session = zenoh.open(make_zenoh_config(endpoint, receive_buffer_bytes=SMALL_BUFFER_BYTES))
    payload_sizes: list[int] = []
    subscriber = session.declare_subscriber(
        "**", lambda sample: payload_sizes.append(len(sample.payload))
    )
    while not payload_sizes:
        time.sleep(0.05)
    yield "ready"
    while True:
        time.sleep(REPORT_PERIOD_S)
        payload_sizes.clear()
        yield f"{subscriber} receives"


KINDS: dict[str, Flooder] = {
    "idle": occupy_sessions,
    "lease": request_leases,
    "noise": query_with_random_bytes,
    "garbage": publish_garbage,
    "readers": subscribe_with_patterns,
    "everything": subscribe_everything,
}


def main() -> None:
    """Flood the network until this process is killed or its standard input is closed."""
    kind, endpoint, amount = sys.argv[1:4]
    zenoh.init_log_from_env_or("off")
    threading.Thread(target=_exit_with_standard_input, daemon=True).start()
    for line in KINDS[kind](endpoint, int(amount)):
        print(line, flush=True)


def _exit_with_standard_input() -> None:
    """End this process when its standard input is closed."""
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()

"""`snakesim topic`: lists the keys, prints the messages on one as one JSON object a line, or measures their rate."""

import contextlib
import itertools
import json
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from queue import Empty
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, WireError, shorten, suggest_word
from snakesim_hal.base.terminal import print_json, print_line, print_stderr
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import (
    Session,
    key_expressions_intersect,
    normalize_key_expression,
)
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import get_decoder
from snakesim_hal.wire.messages import CustomSample
from snakesim_operator.base.targets import RobotSelection, open_sessions

RATE_PERIOD_S = 1.0
MAX_QUEUED_BYTES = 64 * 1024 * 1024  # while the terminal or pipe is slower than the network


def print_topics(*, as_json: bool) -> int:
    """Print the keys on which a robot publishes, with their content. Returns the exit code."""
    if as_json:
        rows = [
            {"key": row.key, "kind": row.kind, "writer": row.writer, "description": row.description}
            for row in _list_published_topics()
        ]
        print_json({"topics": rows})
        return 0
    for line in _format_key_list():
        print_line(line)
    print_stderr(
        "`snakesim topic echo KEY` prints the messages; `snakesim topic rate` shows the rates of all keys"
    )
    return 0


def echo_messages(key: str, selection: RobotSelection, *, count: int | None) -> int:
    """Print messages on a key, from every addressed robot.

    Args:
        key: Key relative to the robot; wildcards are allowed.
        selection: Selects the robots.
        count: Number of messages after which the command ends. If None, it does not end.

    Returns:
        0, the exit code of the command.

    Raises:
        NotConnectedError: No robot is reachable.
        ConfigError: There is no such key.
    """
    with _subscribe_to_key(key, selection) as queue:
        _print_messages(queue, count)
    return 0


def print_rates(key: str, selection: RobotSelection, *, count: int | None, as_json: bool) -> int:
    """Print the rate of the messages on a key once a second, from every addressed robot.

    Args:
        key: Key relative to the robot; wildcards are allowed.
        selection: Selects the robots.
        count: Number of seconds after which the command ends. If None, it does not end.
        as_json: Whether to print one JSON object a second instead of text.

    Returns:
        The exit code: 1 if no message has arrived in the last second, otherwise 0.

    Raises:
        NotConnectedError: No robot is reachable.
        ConfigError: There is no such key.
    """
    with _subscribe_to_key(key, selection) as queue:
        return _print_rate_lines(queue, count, as_json=as_json)


@contextlib.contextmanager
def _subscribe_to_key(key: str, selection: RobotSelection) -> Iterator["OutputQueue"]:
    """Subscribe to a key of every selected robot, and yield the queue that gets the messages.

    Args:
        key: Key or key expression relative to the namespace of a robot, such as `joints` or `sensors/*`.
        selection: Network and namespace of the robots.

    Raises:
        NotConnectedError: No robot is reachable.
        ConfigError: There is no such key.
    """
    relative_key = normalize_key_expression(key.strip("/"))
    topics = [
        topic
        for topic in _list_published_topics()
        if key_expressions_intersect(relative_key, topic.key)
    ]
    if not topics:
        hint = suggest_word(key, [topic.key for topic in _list_published_topics()]).strip()
        lines = [*_format_key_list(), hint] if hint else _format_key_list()
        raise ConfigError(
            f"there is no key {shorten(key)!r}; available keys:", *lines, code="network/unknown-key"
        )
    # A session with a namespace adds it to keys. Without one, `**/` stands for the namespace of any robot.
    prefix = "" if selection.namespace is not None else "**/"
    queue = OutputQueue()
    with contextlib.ExitStack() as stack:
        for _namespace, session in open_sessions(selection, stack):
            _subscribe_to_topics(
                session, queue, normalize_key_expression(f"{prefix}{relative_key}"), prefix, topics
            )
        yield queue


def _subscribe_to_topics(
    session: Session, queue: "OutputQueue", pattern: str, prefix: str, topics: Sequence[keys.KeyRow]
) -> None:
    """Subscribe to the latched keys and to the streams separately.

    A latched value is older than the samples of the streams: a subscriber to both would drop it as too old.

    Args:
        session: Session on one network.
        queue: Gets the messages.
        pattern: Key expression of the requested keys, with wildcards.
        prefix: Prefix of every key on this network: empty, or a wildcard for the namespaces of the robots.
        topics: Rows of the key space that match the pattern.
    """
    latched_keys = [f"{prefix}{topic.key}" for topic in topics if topic.kind == "latched"]
    for latched_key in latched_keys:
        session.on_latched_arrival(
            latched_key,
            queue.make_filtered_add(lambda key: key_expressions_intersect(pattern, key)),
        )
    if len(latched_keys) < len(topics):
        session.on_arrival(
            pattern,
            queue.make_filtered_add(
                lambda key: (
                    not any(
                        key_expressions_intersect(latched_key, key) for latched_key in latched_keys
                    )
                )
            ),
        )


def _list_published_topics() -> list[keys.KeyRow]:
    """Return the rows of the key space whose messages are published."""
    return [topic for topic in keys.SPACE if topic.kind in ("stream", "latched")]


def _format_key_list() -> list[str]:
    topics = _list_published_topics()
    width = max(len(topic.key) for topic in topics)
    return [f"  {topic.key:<{width}}  {topic.description}" for topic in topics]


class MeasuredRate(msgspec.Struct, frozen=True, kw_only=True):
    """The rate of the messages on a key within RATE_PERIOD_S."""

    key: str
    rate_hz: float
    min_gap_ms: float
    max_gap_ms: float
    deviation_ms: float
    messages: int

    def describe(self) -> str:
        """Return a line for the terminal."""
        return (
            f"{self.key}: {self.rate_hz:.1f} Hz  gap {self.min_gap_ms:.2f} to {self.max_gap_ms:.2f} ms"
            f"  deviation {self.deviation_ms:.2f} ms  over {self.messages}"
        )


class OutputQueue:
    """Queues received messages for the terminal. If the terminal is too slow, the newest are dropped and counted."""

    def __init__(self) -> None:
        self._arrivals: Mailbox[ReceivedSample] = Mailbox()
        self._lock = threading.Lock()
        self._queued_bytes = 0
        self._dropped_count = 0

    def add(self, arrival: ReceivedSample) -> None:
        """Add a message, or drop it if the queue is full. This runs in Zenoh's threads."""
        with self._lock:
            if self._queued_bytes + len(arrival.payload) > MAX_QUEUED_BYTES:
                self._dropped_count += 1
                return
            self._queued_bytes += len(arrival.payload)
        self._arrivals.put(arrival)

    def make_filtered_add(
        self, is_selected: Callable[[str], bool]
    ) -> Callable[[ReceivedSample], None]:
        """Return a function that adds a message if `is_selected` returns true for its key."""

        def add_if_selected(arrival: ReceivedSample) -> None:
            if is_selected(arrival.key):
                self.add(arrival)

        return add_if_selected

    def get(self, timeout: float | None = None) -> ReceivedSample:
        """Return the oldest sample. Raises queue.Empty after `timeout` in s; None waits without a limit."""
        if self._dropped_count and self._arrivals.empty():
            print_stderr(
                f"{self._dropped_count} messages were dropped: they came faster than they could be printed"
            )
            self._dropped_count = 0
        arrival = self._arrivals.get(timeout)
        with self._lock:
            self._queued_bytes -= len(arrival.payload)
        return arrival


def _print_messages(queue: OutputQueue, count: int | None) -> None:
    for _ in _count_up_to(count):
        arrival = queue.get()
        content = {"key": arrival.key, **_decode_content(arrival)}
        print_line(json.dumps(content, ensure_ascii=False, separators=(",", ":")))


def _count_up_to(count: int | None) -> Iterable[int]:
    """Return the numbers from 0 up to a count, without the count itself. If the count is None, they do not end."""
    return itertools.count() if count is None else range(count)


def _decode_content(arrival: ReceivedSample) -> dict[str, Any]:
    """Return the decoded message under the name "message", or the reason why it cannot be decoded under "error"."""
    message = keys.find_message(arrival.key)
    if message is None:
        namespace_and_key = keys.split_namespace(arrival.key)
        if namespace_and_key is not None:
            message = keys.find_message(namespace_and_key[1])
    if message is None:
        return {"error": "no message is known on this key"}
    try:
        decoded = get_decoder(message).decode(arrival.payload, arrival.encoding)
    except WireError as error:
        return {"error": str(error)}
    # As it was sent, because only its robot describes some of the fields.
    if message is CustomSample:
        return {"message": msgspec.msgpack.decode(arrival.payload)}
    return {"message": msgspec.to_builtins(decoded)}


def _print_rate_lines(queue: OutputQueue, count: int | None, *, as_json: bool) -> int:
    """Print the rate of each key once in RATE_PERIOD_S.

    Args:
        queue: Has the received messages.
        count: Number of periods after which this ends. If None, it does not end.
        as_json: Whether to print one JSON object for each period instead of text.

    Returns:
        The exit code: 1 if nothing arrived in the last period, otherwise 0.
    """
    exit_code = 0
    for _ in _count_up_to(count):
        times_ns_by_key = _collect_arrival_times(queue)
        rates = [
            rate
            for key in sorted(times_ns_by_key)
            if (rate := _measure_rate(key, times_ns_by_key[key])) is not None
        ]
        exit_code = 0 if times_ns_by_key else 1
        if as_json:
            print_json({"rates": rates})
            continue
        for rate in rates:
            print_line(rate.describe())
        if not times_ns_by_key:
            print_line("nothing arrives")
    return exit_code


def _collect_arrival_times(queue: OutputQueue) -> dict[str, list[int]]:
    """Collect messages for RATE_PERIOD_S, and return their arrival times in ns by key."""
    times_ns_by_key: dict[str, list[int]] = {}
    deadline_s = time.monotonic() + RATE_PERIOD_S
    while (remaining_s := deadline_s - time.monotonic()) > 0:
        try:
            arrival = queue.get(timeout=remaining_s)
        except Empty:
            break
        times_ns_by_key.setdefault(arrival.key, []).append(arrival.monotonic_ns)
    return times_ns_by_key


def _measure_rate(key: str, times_ns: list[int]) -> MeasuredRate | None:
    """Return the rate of a key; None if fewer than two messages arrived."""
    gaps_ms = [(later - earlier) / 1e6 for earlier, later in itertools.pairwise(times_ns)]
    if not gaps_ms:
        return None
    return MeasuredRate(
        key=key,
        rate_hz=1000 / statistics.fmean(gaps_ms),
        min_gap_ms=min(gaps_ms),
        max_gap_ms=max(gaps_ms),
        deviation_ms=statistics.pstdev(gaps_ms),
        messages=len(times_ns),
    )

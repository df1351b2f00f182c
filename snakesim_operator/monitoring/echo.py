"""`snakesim echo`: prints the messages on a key, as one JSON object a line, or their rate."""

import contextlib
import itertools
import json
import statistics
import threading
import time
from collections.abc import Callable
from queue import Empty
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, WireError, did_you_mean, short
from snakesim_hal.base.terminal import print_stderr, say
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Arrival, intersects, key_expression
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import OwnSample
from snakesim_operator.base.targets import RobotSelection, sessions_on
from snakesim_operator.monitoring.traffic import decoder_of

RATE_PERIOD_S = 1.0
MAX_WAITING_BYTES = 64 * 1024 * 1024  # while the terminal or pipe is slower than the network


def echo(key: str | None, where: RobotSelection, *, rate_only: bool, count: int | None) -> int:
    """Print messages on a key, from every addressed robot. Raises NotConnectedError, ConfigError.

    key: relative to the robot, wildcards allowed; None: list the keys. count: after which it ends; None: never.
    """
    if key is None:
        for line in _key_lines():
            say(line)
        print_stderr("`snakesim echo KEY` prints the messages, --hz their rate; `snakesim top` shows all rates at once")
        return 0
    relative = key_expression(key.strip("/"))
    rows = [row for row in _echoed() if intersects(relative, row.key)]
    if not rows:
        meant = did_you_mean(key, [row.key for row in _echoed()]).strip()
        lines = [*_key_lines(), meant] if meant else _key_lines()
        raise ConfigError(f"there is no key {short(key)!r}; available keys:", *lines)
    latched = tuple(row.key for row in rows if row.kind == "latched")
    within = "" if where.namespace is not None else "**/"
    pattern, latched_keys = key_expression(f"{within}{relative}"), tuple(f"{within}{one}" for one in latched)
    waiting = OutputQueue()
    with contextlib.ExitStack() as stack:
        for _, session in sessions_on(where, stack):
            # A latched value is older than the streams: a subscriber to both would drop it as too old.
            for one in latched_keys:
                session.on_latched_arrival(one, waiting.only(lambda found: intersects(pattern, found)))
            if len(latched) < len(rows):
                session.on_arrival(
                    pattern, waiting.only(lambda found: not any(intersects(one, found) for one in latched_keys))
                )
        (_print_rates if rate_only else _print_messages)(waiting, count)
    return 0


def _echoed() -> list[keys.Row]:
    return [row for row in keys.SPACE if row.kind in ("stream", "latched")]


def _key_lines() -> list[str]:
    width = max(len(row.key) for row in _echoed())
    return [f"  {row.key:<{width}}  {row.about}" for row in _echoed()]


class OutputQueue:
    """Samples queued for the terminal; if it is too slow, the newest are dropped, and this is reported."""

    def __init__(self) -> None:
        self._arrivals: Mailbox[Arrival] = Mailbox()
        self._lock = threading.Lock()
        self._bytes = 0
        self._dropped = 0

    def put(self, arrival: Arrival) -> None:
        """Add one; in Zenoh's threads."""
        with self._lock:
            if self._bytes + len(arrival.payload) > MAX_WAITING_BYTES:
                self._dropped += 1
                return
            self._bytes += len(arrival.payload)
        self._arrivals.put(arrival)

    def only(self, wanted: Callable[[str], bool]) -> Callable[[Arrival], None]:
        """Adds samples at keys for which `wanted` is true."""

        def put(arrival: Arrival) -> None:
            if wanted(arrival.key):
                self.put(arrival)

        return put

    def get(self, timeout: float | None = None) -> Arrival:
        """The oldest one. Raises queue.Empty."""
        if self._dropped and self._arrivals.empty():
            print_stderr(f"{self._dropped} messages were dropped: they came faster than they could be printed")
            self._dropped = 0
        arrival = self._arrivals.get(timeout)
        with self._lock:
            self._bytes -= len(arrival.payload)
        return arrival


def _print_messages(waiting: OutputQueue, count: int | None) -> None:
    for _ in itertools.count() if count is None else range(count):
        arrival = waiting.get()
        content = {"key": arrival.key, **_content(arrival)}
        say(json.dumps(content, ensure_ascii=False, separators=(",", ":")))


def _content(arrival: Arrival) -> dict[str, Any]:
    message = keys.message_at(arrival.key)
    if message is None and (split := keys.split_namespace(arrival.key)) is not None:
        message = keys.message_at(split[1])
    if message is None:
        return {"error": "no message is known on this key"}
    try:
        decoded = decoder_of(message).decode(arrival.payload, arrival.encoding)
        if message is OwnSample:  # with the fields that only its robot describes, as they were sent
            return {"message": msgspec.msgpack.decode(arrival.payload)}
        return {"message": msgspec.to_builtins(decoded)}
    except WireError as error:
        return {"error": str(error)}


def _print_rates(waiting: OutputQueue, count: int | None) -> None:
    for _ in itertools.count() if count is None else range(count):
        stamps: dict[str, list[int]] = {}
        until = time.monotonic() + RATE_PERIOD_S
        while (left := until - time.monotonic()) > 0:
            try:
                arrival = waiting.get(timeout=left)
            except Empty:
                break
            stamps.setdefault(arrival.key, []).append(arrival.monotonic_ns)
        for key, times in sorted(stamps.items()):
            gaps_ms = [(b - a) / 1e6 for a, b in itertools.pairwise(times)]
            if gaps_ms:
                spread = statistics.pstdev(gaps_ms)
                say(
                    f"{key}: {1000 / statistics.fmean(gaps_ms):.1f} Hz  gap {min(gaps_ms):.2f} to {max(gaps_ms):.2f} ms"
                    f"  deviation {spread:.2f} ms  over {len(times)}"
                )
        if not stamps:
            say("nothing arrives")

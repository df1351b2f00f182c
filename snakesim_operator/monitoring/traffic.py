"""Measures what arrives on a network: rate, jitter, size and age for each key, and the latency of commands.

The memory is bounded: it holds only the newest arrivals of each key.
"""

import itertools
import statistics
import threading
from collections import deque
from functools import cache
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.streams import Arrival
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Clock,
    Description,
    JointCommand,
    JointState,
    Message,
    Status,
    Timing,
)

MAX_KEYS = 512  # an unknown client may invent more; arrivals on those are only counted
MAX_ARRIVALS = 256  # newest arrivals of a key
WINDOW_NS = 5_000_000_000  # rates are computed over this duration
TIMED: dict[str, type[Message]] = {
    keys.JOINTS: JointState,
    keys.JOINT_COMMAND: JointCommand,
    keys.APPLIED: AppliedCommand,
}
MAX_TIMED = 1024  # newest states and commands, from which the latency is computed
TIMED_BYTES = 16384  # larger ones are dropped; a command of 256 joints has 4 kB

decoder_of = cache(Decoder)


class KeyTraffic(msgspec.Struct, frozen=True, kw_only=True):
    """One line of `snakesim topic rate`; None where it is unknown."""

    robot: str
    key: str
    writer: str | None  # from the key space; None: the key is not in it
    failure: str = ""  # why the newest message cannot be read
    rate_hz: float | None
    jitter_ms: float | None  # standard deviation of the gaps
    gap_max_ms: float | None
    bytes: int  # of the newest message
    received_ago_s: float
    age_ms: float | None  # of the newest data, by its timestamp and the robot's clock


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """Time from a joint state to the command that answers it, and to the motors.

    A busy computer delays the arrivals that are measured here.
    """

    robot: str
    arrival_median_ms: float  # from the state's arrival here to the command's
    arrival_p99_ms: float
    motors_median_ms: float | None  # from the state's timestamp to the first tick that applied the command; robot time
    motors_p99_ms: float | None
    count: int


class Traffic:
    """Collects arrivals, from any thread; the other methods evaluate them."""

    def __init__(self, namespace: str | None = None) -> None:
        """Begin without arrivals. namespace: of the only robot; None when keys begin with a namespace."""
        self.keys_left_out = 0  # arrivals on keys beyond MAX_KEYS
        self._namespace = namespace
        self._lock = threading.Lock()
        self._newest: dict[str, Arrival] = {}  # by key
        self._times_ns: dict[str, deque[int]] = {}  # by key
        self._timed: dict[tuple[str, type[Message]], deque[Arrival]] = {}  # by prefix of the key and message

    def add(self, arrival: Arrival) -> None:
        """Add an arrival. This runs in Zenoh's threads, so no message is decoded here."""
        with self._lock:
            if arrival.key not in self._newest and len(self._newest) >= MAX_KEYS:
                self.keys_left_out += 1
                return
            self._newest[arrival.key] = arrival
            self._times_ns.setdefault(arrival.key, deque(maxlen=MAX_ARRIVALS)).append(arrival.monotonic_ns)
            if len(arrival.payload) <= TIMED_BYTES:
                self._add_timed(arrival)

    def _add_timed(self, arrival: Arrival) -> None:
        """Keep a state or a command, from which the latency is computed."""
        for suffix, message in TIMED.items():
            if f"/{arrival.key}".endswith(f"/{suffix}"):
                prefix = arrival.key.removesuffix(suffix)
                self._timed.setdefault((prefix, message), deque(maxlen=MAX_TIMED)).append(arrival)

    def lines(self, now_ns: int) -> list[KeyTraffic]:
        """Return the traffic of every key, sorted by robot and key. now_ns: of the monotonic clock."""
        with self._lock:
            newest = dict(self._newest)
            recent_ns: dict[str, list[int]] = {}
            for key, times_ns in self._times_ns.items():
                recent_ns[key] = [time_ns for time_ns in times_ns if now_ns - time_ns <= WINDOW_NS]
        contents = {key: _decode(self._split(key)[1], arrival) for key, arrival in newest.items()}
        clocks_ns = self._robot_clocks(contents)
        holders = self._lease_holders(contents)
        lines: list[KeyTraffic] = []
        for key, arrival in newest.items():
            robot, relative = self._split(key)
            content = contents[key]
            lines.append(
                KeyTraffic(
                    robot=robot,
                    key=relative,
                    writer=_find_writer(relative, holders.get(robot)),
                    failure=content if isinstance(content, str) else "",
                    **_measure_rhythm(recent_ns[key]),
                    bytes=len(arrival.payload),
                    received_ago_s=max(now_ns - arrival.monotonic_ns, 0) * 1e-9,
                    age_ms=_age_ms(content, clocks_ns.get(robot)),
                )
            )
        return sorted(lines, key=lambda line: (line.robot, line.writer is None, line.key))

    def _robot_clocks(self, contents: dict[str, Any]) -> dict[str, int]:
        """Return the newest time in ns that each robot published."""
        return {self._split(key)[0]: clock.timestamp_ns for key, clock in contents.items() if isinstance(clock, Clock)}

    def _lease_holders(self, contents: dict[str, Any]) -> dict[str, str | None]:
        """Return the holder of each robot's lease; None if the lease is not held."""
        return {
            self._split(key)[0]: status.lease_holder for key, status in contents.items() if isinstance(status, Status)
        }

    def latencies(self) -> list[Latency]:
        """Return the latency of every robot that is commanded."""
        with self._lock:
            timed = {prefix_and_message: list(arrivals) for prefix_and_message, arrivals in self._timed.items()}
        latencies: list[Latency] = []
        for prefix in sorted(prefix for prefix, message in timed if message is JointCommand):
            latency = self._measure_latency(
                prefix,
                states=_decode_all(timed.get((prefix, JointState), []), JointState),
                commands=_decode_all(timed[prefix, JointCommand], JointCommand),
                applied=_decode_all(timed.get((prefix, AppliedCommand), []), AppliedCommand),
            )
            if latency is not None:
                latencies.append(latency)
        return latencies

    def _measure_latency(
        self,
        prefix: str,
        states: list[tuple[Any, int]],
        commands: list[tuple[Any, int]],
        applied: list[tuple[Any, int]],
    ) -> Latency | None:
        """Match each command with the state that it answers, and with the tick that applied it first.

        Args:
            prefix: of the robot's keys.
            states: joint states with the time of their arrival in ns, as the other two.
            commands: joint commands.
            applied: commands that the host has applied.

        Returns:
            The latency; None when no command answers a known state.
        """
        state_by_tick = {state.tick: (state, arrival_ns) for state, arrival_ns in states}
        applied_ns: dict[int, int] = {}  # robot time by sequence number of the command
        for command, _ in applied:
            applied_ns.setdefault(command.sequence, command.timestamp_ns)
        arrival_ms: list[float] = []
        motors_ms: list[float] = []
        for command, command_arrival_ns in commands:
            if command.tick not in state_by_tick:
                continue
            state, state_arrival_ns = state_by_tick[command.tick]
            arrival_ms.append((command_arrival_ns - state_arrival_ns) * 1e-6)
            if command.sequence in applied_ns:
                motors_ms.append((applied_ns[command.sequence] - state.timestamp_ns) * 1e-6)
        if not arrival_ms:
            return None
        arrival_median_ms, arrival_p99_ms = _median_and_p99(arrival_ms)
        motors_median_ms, motors_p99_ms = _median_and_p99(motors_ms)
        return Latency(
            robot=self._namespace or prefix.rstrip("/"),
            arrival_median_ms=arrival_median_ms or 0.0,
            arrival_p99_ms=arrival_p99_ms or 0.0,
            motors_median_ms=motors_median_ms,
            motors_p99_ms=motors_p99_ms,
            count=len(arrival_ms),
        )

    def tick_times(self) -> dict[str, dict[str, Timing]]:
        """Return the tick times of every robot from its newest status; empty for one that was not armed yet."""
        statuses = self._decode_newest(keys.STATUS)
        return {robot: status.tick_times for robot, status in statuses.items() if isinstance(status, Status)}

    def descriptions(self) -> dict[str, Description]:
        """Return the newest description of every robot that publishes one."""
        contents = self._decode_newest(keys.DESCRIPTION)
        return {robot: content for robot, content in contents.items() if isinstance(content, Description)}

    def _decode_newest(self, relative_key: str) -> dict[str, Any]:
        """Return each robot's newest message at a key, or why it cannot be read."""
        with self._lock:
            newest = dict(self._newest)
        contents: dict[str, Any] = {}
        for key, arrival in newest.items():
            robot, relative = self._split(key)
            if relative == relative_key:
                contents[robot] = _decode(relative, arrival)
        return contents

    def is_known(self, key: str) -> bool:
        """Return whether a robot publishes at this key, by the key space."""
        row = keys.find_row(self._split(key)[1])
        return row is not None and row.kind in ("stream", "latched")

    def _split(self, key: str) -> tuple[str, str]:
        """Return a key's robot, and the key relative to it; the name is empty for a key that belongs to no robot."""
        if self._namespace is not None:
            return self._namespace, key
        return keys.split_namespace(key) or ("", key)


def _find_writer(relative_key: str, lease_holder: str | None) -> str | None:
    """Return the process that writes at a key; None for a key that is not in the key space."""
    if relative_key == keys.JOINT_COMMAND and lease_holder:
        return f"{lease_holder} (lease)"
    row = keys.find_row(relative_key)
    if row is None:
        return None
    if row.writer.startswith("each "):
        return keys.parse_service(relative_key)
    return row.writer


def _age_ms(content: Any, clock_ns: int | None) -> float | None:
    """Return the age of a message by the robot's clock; None when the message or the clock has no time."""
    timestamp_ns = getattr(content, "timestamp_ns", None)
    if timestamp_ns is None or clock_ns is None:
        return None
    return max(clock_ns - timestamp_ns, 0) * 1e-6


def _median_and_p99(values: list[float]) -> tuple[float | None, float | None]:
    """Return the median and the 99th percentile; None without values."""
    if not values:
        return None, None
    index = min(int(0.99 * len(values)), len(values) - 1)
    return statistics.median(values), sorted(values)[index]


def _measure_rhythm(times_ns: list[int]) -> dict[str, float | None]:
    """Return rate, jitter and the longest gap of arrivals; None for fewer than two."""
    gaps_ms = [(later - earlier) * 1e-6 for earlier, later in itertools.pairwise(times_ns)]
    if not gaps_ms or sum(gaps_ms) == 0:
        return {"rate_hz": None, "jitter_ms": None, "gap_max_ms": None}
    return {
        "rate_hz": 1e3 / statistics.fmean(gaps_ms),
        "jitter_ms": statistics.pstdev(gaps_ms),
        "gap_max_ms": max(gaps_ms),
    }


def _decode(relative_key: str, arrival: Arrival) -> Any:
    """Return the message; or, as text, why it cannot be read."""
    message = keys.find_message(relative_key)
    if message is None:
        return "not in the key space"
    try:
        return decoder_of(message).decode(arrival.payload, arrival.encoding)
    except WireError as error:
        return error.reason


def _decode_all(arrivals: list[Arrival], message: type[Message]) -> list[tuple[Any, int]]:
    """Return the messages that can be read, with the time of their arrival in ns."""
    decoded: list[tuple[Any, int]] = []
    for arrival in arrivals:
        try:
            content = decoder_of(message).decode(arrival.payload, arrival.encoding)
        except WireError:
            continue
        decoded.append((content, arrival.monotonic_ns))
    return decoded

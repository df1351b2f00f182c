"""Measures what arrives on a network: rate, jitter, size and age for each key, and the latency of commands.

The memory is bounded: it holds only the newest arrivals of each key.
"""

import itertools
import statistics
import threading
from collections import deque
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MessageT, get_decoder
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Clock,
    JointCommand,
    JointState,
    Message,
    RobotDescription,
    RobotStatus,
    TimingStatistics,
)

MAX_KEYS = 512  # an unknown client may invent more; arrivals on those are only counted
MAX_ARRIVAL_TIMES = 256  # newest arrivals of a key
RATE_WINDOW_NS = 5_000_000_000  # rates are computed over this duration
LATENCY_MESSAGE_TYPES: dict[str, type[Message]] = {
    keys.JOINTS: JointState,
    keys.JOINT_COMMAND: JointCommand,
    keys.APPLIED: AppliedCommand,
}
MAX_LATENCY_MESSAGES = 1024  # newest states and commands, from which the latency is computed
MAX_LATENCY_MESSAGE_BYTES = 16384  # larger ones are dropped; a command of 256 joints has 4 kB


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


class CommandLatency(msgspec.Struct, frozen=True, kw_only=True):
    """Time from a joint state to the command that answers it, and to the motors.

    A busy computer delays the arrivals that are measured here.
    """

    robot: str
    arrival_median_ms: float  # from the state's arrival here to the command's
    arrival_p99_ms: float
    # From the state's timestamp to the first tick that applied the command; robot time.
    motors_median_ms: float | None
    motors_p99_ms: float | None
    count: int


class NetworkTraffic:
    """Collects what arrives on one network, from any thread, and measures rates and latencies of it."""

    def __init__(self, namespace: str | None = None) -> None:
        """Start without arrivals.

        Args:
            namespace: Namespace of the only robot, relative to which keys arrive. None if keys begin with a namespace.
        """
        self.keys_left_out = 0  # arrivals on keys beyond MAX_KEYS
        self._namespace = namespace
        self._lock = threading.Lock()
        self._newest_by_key: dict[str, ReceivedSample] = {}  # by key
        self._arrival_times_ns_by_key: dict[str, deque[int]] = {}  # by key
        # By prefix of the key and message.
        self._latency_arrivals: dict[tuple[str, type[Message]], deque[ReceivedSample]] = {}

    def add(self, arrival: ReceivedSample) -> None:
        """Add an arrival. This runs in Zenoh's threads, so no message is decoded here."""
        with self._lock:
            if arrival.key not in self._newest_by_key and len(self._newest_by_key) >= MAX_KEYS:
                self.keys_left_out += 1
                return
            self._newest_by_key[arrival.key] = arrival
            self._arrival_times_ns_by_key.setdefault(
                arrival.key, deque(maxlen=MAX_ARRIVAL_TIMES)
            ).append(arrival.monotonic_ns)
            if len(arrival.payload) <= MAX_LATENCY_MESSAGE_BYTES:
                self._keep_latency_arrival(arrival)

    def _keep_latency_arrival(self, arrival: ReceivedSample) -> None:
        """Keep an arrival if it is a joint state or a command, from which the latency is computed."""
        for suffix, message in LATENCY_MESSAGE_TYPES.items():
            if f"/{arrival.key}".endswith(f"/{suffix}"):
                prefix = arrival.key.removesuffix(suffix)
                self._latency_arrivals.setdefault(
                    (prefix, message), deque(maxlen=MAX_LATENCY_MESSAGES)
                ).append(arrival)

    def measure_keys(self, now_ns: int) -> list[KeyTraffic]:
        """Return the traffic of every key, sorted by robot and key; unknown keys are last.

        Args:
            now_ns: Current time of the monotonic clock.
        """
        with self._lock:
            newest = dict(self._newest_by_key)
            recent_times_ns_by_key: dict[str, list[int]] = {}
            for key, times_ns in self._arrival_times_ns_by_key.items():
                recent_times_ns_by_key[key] = [
                    time_ns for time_ns in times_ns if now_ns - time_ns <= RATE_WINDOW_NS
                ]
        content_by_key = {
            key: _decode_or_explain(self._split_namespace(key)[1], arrival)
            for key, arrival in newest.items()
        }
        clock_ns_by_robot = self._find_robot_clocks_ns(content_by_key)
        lease_holder_by_robot = self._find_lease_holders(content_by_key)
        lines: list[KeyTraffic] = []
        for key, arrival in newest.items():
            robot, relative_key = self._split_namespace(key)
            content = content_by_key[key]
            lines.append(
                KeyTraffic(
                    robot=robot,
                    key=relative_key,
                    writer=_find_writer(relative_key, lease_holder_by_robot.get(robot)),
                    failure=content if isinstance(content, str) else "",
                    **_measure_arrival_rate(recent_times_ns_by_key[key]),
                    bytes=len(arrival.payload),
                    received_ago_s=max(now_ns - arrival.monotonic_ns, 0) * 1e-9,
                    age_ms=_compute_age_ms(content, clock_ns_by_robot.get(robot)),
                )
            )
        return sorted(lines, key=lambda line: (line.robot, line.writer is None, line.key))

    def _find_robot_clocks_ns(self, contents: dict[str, Any]) -> dict[str, int]:
        """Return the newest robot time in ns by robot, from the clock messages.

        Args:
            contents: Newest decoded message by key.
        """
        return {
            self._split_namespace(key)[0]: clock.timestamp_ns
            for key, clock in contents.items()
            if isinstance(clock, Clock)
        }

    def _find_lease_holders(self, contents: dict[str, Any]) -> dict[str, str | None]:
        """Return the holder of the command lease by robot, from the status messages; None if the lease is not held.

        Args:
            contents: Newest decoded message by key.
        """
        return {
            self._split_namespace(key)[0]: status.lease_holder
            for key, status in contents.items()
            if isinstance(status, RobotStatus)
        }

    def measure_latencies(self) -> list[CommandLatency]:
        """Return the latency of every robot whose commands answer known joint states."""
        with self._lock:
            arrivals_by_source = {
                source: list(arrivals) for source, arrivals in self._latency_arrivals.items()
            }
        latencies: list[CommandLatency] = []
        prefixes = sorted(
            prefix for prefix, message_type in arrivals_by_source if message_type is JointCommand
        )
        for prefix in prefixes:
            latency = self._measure_latency(
                prefix,
                states=_decode_readable(
                    arrivals_by_source.get((prefix, JointState), []), JointState
                ),
                commands=_decode_readable(arrivals_by_source[prefix, JointCommand], JointCommand),
                applied_commands=_decode_readable(
                    arrivals_by_source.get((prefix, AppliedCommand), []), AppliedCommand
                ),
            )
            if latency is not None:
                latencies.append(latency)
        return latencies

    def _measure_latency(
        self,
        prefix: str,
        states: list[tuple[JointState, int]],
        commands: list[tuple[JointCommand, int]],
        applied_commands: list[tuple[AppliedCommand, int]],
    ) -> CommandLatency | None:
        """Measure the time from each joint state to the command that answers it, and to the motors.

        The response latency is the difference of arrival times by this computer's clock. The actuation latency is the
        difference of timestamps in robot time, from the state to the first applied command with the same sequence
        number.

        Args:
            prefix: Prefix of the robot's keys; without its last slash, it is the name of the robot in the result.
            states: Joint states, each with the monotonic time of its arrival in ns.
            commands: Joint commands, each with the monotonic time of its arrival in ns.
            applied_commands: Commands that the host has applied, each with the monotonic time of its arrival in ns.

        Returns:
            The latency, or None if no command answers a known state.
        """
        state_by_tick = {state.tick: (state, arrival_ns) for state, arrival_ns in states}
        applied_time_ns_by_sequence: dict[int, int] = {}
        for applied_command, _ in applied_commands:
            # A command is applied again in each tick until its successor; the first time counts. The sequence number is
            # None in ticks in which the host applied no command.
            if applied_command.sequence is not None:
                applied_time_ns_by_sequence.setdefault(
                    applied_command.sequence, applied_command.timestamp_ns
                )
        response_latencies_ms: list[float] = []
        actuation_latencies_ms: list[float] = []
        for command, command_arrival_ns in commands:
            if command.tick not in state_by_tick:
                continue
            state, state_arrival_ns = state_by_tick[command.tick]
            response_latencies_ms.append((command_arrival_ns - state_arrival_ns) * 1e-6)
            if command.sequence in applied_time_ns_by_sequence:
                actuation_ns = applied_time_ns_by_sequence[command.sequence] - state.timestamp_ns
                actuation_latencies_ms.append(actuation_ns * 1e-6)
        response_median_ms, response_p99_ms = _compute_median_and_p99(response_latencies_ms)
        if response_median_ms is None or response_p99_ms is None:
            return None
        actuation_median_ms, actuation_p99_ms = _compute_median_and_p99(actuation_latencies_ms)
        return CommandLatency(
            robot=self._namespace or prefix.rstrip("/"),
            arrival_median_ms=response_median_ms,
            arrival_p99_ms=response_p99_ms,
            motors_median_ms=actuation_median_ms,
            motors_p99_ms=actuation_p99_ms,
            count=len(response_latencies_ms),
        )

    def read_tick_times(self) -> dict[str, dict[str, TimingStatistics]]:
        """Return the tick times of every robot from its newest status; empty for one that was not armed yet."""
        statuses = self._decode_newest(keys.STATUS)
        return {
            robot: status.tick_times
            for robot, status in statuses.items()
            if isinstance(status, RobotStatus)
        }

    def read_descriptions(self) -> dict[str, RobotDescription]:
        """Return the newest description by robot, of every robot that publishes one."""
        contents = self._decode_newest(keys.DESCRIPTION)
        return {
            robot: content
            for robot, content in contents.items()
            if isinstance(content, RobotDescription)
        }

    def _decode_newest(self, relative_key: str) -> dict[str, Any]:
        """Return the newest message at a key by robot; a text in its place is the reason why it is unreadable."""
        with self._lock:
            newest = dict(self._newest_by_key)
        contents: dict[str, Any] = {}
        for key, arrival in newest.items():
            robot, relative = self._split_namespace(key)
            if relative == relative_key:
                contents[robot] = _decode_or_explain(relative, arrival)
        return contents

    def is_known_key(self, key: str) -> bool:
        """Return whether a robot publishes at this key, by the key space."""
        row = keys.find_row(self._split_namespace(key)[1])
        return row is not None and row.kind in ("stream", "latched")

    def _split_namespace(self, key: str) -> tuple[str, str]:
        """Split a key into the name of its robot and the key relative to the robot.

        The name is empty for a key that belongs to no robot.
        """
        if self._namespace is not None:
            return self._namespace, key
        return keys.split_namespace(key) or ("", key)


def _find_writer(relative_key: str, lease_holder: str | None) -> str | None:
    """Return the name of the process that writes at a key, by the key space; None if the key is not in it.

    Args:
        relative_key: Key relative to the robot.
        lease_holder: Holder of the robot's command lease, who writes the joint commands; None if it is not held.
    """
    if relative_key == keys.JOINT_COMMAND and lease_holder:
        return f"{lease_holder} (lease)"
    row = keys.find_row(relative_key)
    if row is None:
        return None
    if row.writer.startswith("each "):
        return keys.parse_service(relative_key)
    return row.writer


def _compute_age_ms(content: Any, clock_ns: int | None) -> float | None:
    """Return the age of a message by the robot's clock; None when the message or the clock has no time."""
    timestamp_ns = getattr(content, "timestamp_ns", None)
    if timestamp_ns is None or clock_ns is None:
        return None
    return max(clock_ns - timestamp_ns, 0) * 1e-6


def _compute_median_and_p99(values: list[float]) -> tuple[float | None, float | None]:
    """Return the median and the 99th percentile of some values; two times None if there are no values."""
    if not values:
        return None, None
    index = min(int(0.99 * len(values)), len(values) - 1)
    return statistics.median(values), sorted(values)[index]


def _measure_arrival_rate(times_ns: list[int]) -> dict[str, float | None]:
    """Return rate, jitter and the longest gap of arrivals, named as the fields of KeyTraffic; None for fewer than two.

    Args:
        times_ns: Arrival times, oldest first.
    """
    gaps_ms = [(later - earlier) * 1e-6 for earlier, later in itertools.pairwise(times_ns)]
    if not gaps_ms or sum(gaps_ms) == 0:
        return {"rate_hz": None, "jitter_ms": None, "gap_max_ms": None}
    return {
        "rate_hz": 1e3 / statistics.fmean(gaps_ms),
        "jitter_ms": statistics.pstdev(gaps_ms),
        "gap_max_ms": max(gaps_ms),
    }


def _decode_or_explain(relative_key: str, arrival: ReceivedSample) -> Any:
    """Return the decoded message, or a text with the reason why it cannot be decoded."""
    message = keys.find_message(relative_key)
    if message is None:
        return "not in the key space"
    try:
        return get_decoder(message).decode(arrival.payload, arrival.encoding)
    except WireError as error:
        return error.reason


def _decode_readable(
    arrivals: list[ReceivedSample], message_type: type[MessageT]
) -> list[tuple[MessageT, int]]:
    """Return the messages that can be decoded, each with the monotonic time of its arrival in ns."""
    decoded: list[tuple[MessageT, int]] = []
    for arrival in arrivals:
        try:
            content: Any = get_decoder(message_type).decode(arrival.payload, arrival.encoding)
        except WireError:
            continue
        decoded.append((content, arrival.monotonic_ns))
    return decoded

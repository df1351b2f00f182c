"""What arrives on a network, key by key: rate, jitter, size and age, and how long commands take. Of bounded size."""

import itertools
import statistics
import threading
from collections import deque
from functools import cache
from typing import Any

import msgspec

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.session import Arrival
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

MAX_KEYS = 512  # a stranger may invent more; they are only counted
KEPT = 256  # newest arrivals of a key
WINDOW_NS = 5_000_000_000
TIMED: dict[str, type[Message]] = {
    keys.JOINTS: JointState,
    keys.JOINT_COMMAND: JointCommand,
    keys.APPLIED: AppliedCommand,
}
TIMED_KEPT, TIMED_BYTES = 1024, 16384  # states and commands for the latency; a command of 256 joints has 4 kB

decoder_of = cache(Decoder)


class KeyTraffic(msgspec.Struct, frozen=True, kw_only=True):
    """One line of `snakesim top`; None where it is unknown."""

    robot: str
    key: str
    writer: str | None  # as the key space says; None: the key is not in it
    failure: str = ""  # why the newest message cannot be read
    rate_hz: float | None
    jitter_ms: float | None  # standard deviation of the gaps
    gap_max_ms: float | None
    bytes: int  # of the newest message
    heard_ago_s: float
    age_ms: float | None  # of the newest data, by its stamp and the robot's clock


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """From a joint state to the command that answers it, and to the motors. A busy computer delays what is heard."""

    robot: str
    heard_median_ms: float  # from the state's arrival here to the command's
    heard_p99_ms: float
    motors_median_ms: float | None  # from the state's stamp to the first tick that applied the command; robot time
    motors_p99_ms: float | None
    count: int


class Traffic:
    """Collects arrivals, from any thread; `lines` and `latencies` evaluate them."""

    def __init__(self, namespace: str | None = None) -> None:
        """namespace: of the only robot; None when keys begin with one."""
        self._namespace = namespace
        self._lock = threading.Lock()
        self._newest: dict[str, Arrival] = {}
        self._times: dict[str, deque[int]] = {}
        self._timed: dict[tuple[str, type[Message]], deque[Arrival]] = {}
        self.keys_left_out = 0  # arrivals on keys beyond MAX_KEYS

    def take(self, arrival: Arrival) -> None:
        """Count one; in Zenoh's threads, so that nothing is decoded here."""
        with self._lock:
            if arrival.key not in self._newest and len(self._newest) >= MAX_KEYS:
                self.keys_left_out += 1
                return
            self._newest[arrival.key] = arrival
            self._times.setdefault(arrival.key, deque(maxlen=KEPT)).append(arrival.monotonic_ns)
            for suffix, message in TIMED.items():
                if f"/{arrival.key}".endswith(f"/{suffix}") and len(arrival.payload) <= TIMED_BYTES:
                    at = (arrival.key.removesuffix(suffix), message)
                    self._timed.setdefault(at, deque(maxlen=TIMED_KEPT)).append(arrival)

    def lines(self, now_ns: int) -> list[KeyTraffic]:
        """Every key, sorted by robot and key."""
        with self._lock:
            newest = dict(self._newest)
            times = {key: [t for t in stamps if now_ns - t <= WINDOW_NS] for key, stamps in self._times.items()}
        content = {key: _decoded(self._split(key)[1], arrival) for key, arrival in newest.items()}
        robot_ns = {self._split(key)[0]: said.timestamp_ns for key, said in content.items() if isinstance(said, Clock)}
        holders = {self._split(key)[0]: said.lease_holder for key, said in content.items() if isinstance(said, Status)}
        found: list[KeyTraffic] = []
        for key, arrival in newest.items():
            robot, relative = self._split(key)
            row, said = keys.row_at(relative), content[key]
            writer = None if row is None else row.writer
            if writer is not None and writer.startswith("each "):
                writer = keys.service_of(relative)
            if relative == keys.JOINT_COMMAND and holders.get(robot):
                writer = f"{holders[robot]} (lease)"
            timestamp_ns, clock_ns = getattr(said, "timestamp_ns", None), robot_ns.get(robot)
            found.append(
                KeyTraffic(
                    robot=robot,
                    key=relative,
                    writer=writer,
                    failure=said if isinstance(said, str) else "",
                    **_rhythm(times[key]),
                    bytes=len(arrival.payload),
                    heard_ago_s=max(now_ns - arrival.monotonic_ns, 0) * 1e-9,
                    age_ms=None if timestamp_ns is None or clock_ns is None else max(clock_ns - timestamp_ns, 0) * 1e-6,
                )
            )
        return sorted(found, key=lambda line: (line.robot, line.writer is None, line.key))

    def latencies(self) -> list[Latency]:
        """Of every robot that is commanded."""
        with self._lock:
            timed = {at: list(arrivals) for at, arrivals in self._timed.items()}
        found: list[Latency] = []
        for (prefix, message), commands in sorted(timed.items(), key=lambda item: item[0][0]):
            if message is not JointCommand:
                continue
            states = {said.tick: (said, at) for said, at in _read(timed.get((prefix, JointState), []), JointState)}
            answers = [(said, at) for said, at in _read(commands, message) if said.tick in states]
            heard_ms = [(at - states[said.tick][1]) * 1e-6 for said, at in answers]
            acted: dict[int, int] = {}  # sequence -> robot time
            for said, _ in _read(timed.get((prefix, AppliedCommand), []), AppliedCommand):
                acted.setdefault(said.sequence, said.timestamp_ns)
            motors_ms = [
                (acted[said.sequence] - states[said.tick][0].timestamp_ns) * 1e-6
                for said, _ in answers
                if said.sequence in acted
            ]
            if heard_ms:
                heard, motors = _middle_and_most(heard_ms), _middle_and_most(motors_ms)
                found.append(
                    Latency(
                        robot=self._namespace or prefix.rstrip("/"),
                        heard_median_ms=heard[0] or 0.0,
                        heard_p99_ms=heard[1] or 0.0,
                        motors_median_ms=motors[0],
                        motors_p99_ms=motors[1],
                        count=len(heard_ms),
                    )
                )
        return found

    def tick_times(self) -> dict[str, dict[str, Timing]]:
        """Of every robot, as its newest status says; empty for one that was not armed yet."""
        with self._lock:
            newest = dict(self._newest)
        said = {
            robot: _decoded(keys.STATUS, arrival)
            for key, arrival in newest.items()
            for robot, relative in (self._split(key),)
            if relative == keys.STATUS
        }
        return {robot: status.tick_times for robot, status in said.items() if isinstance(status, Status)}

    def descriptions(self) -> dict[str, Description]:
        """Of every robot that has described itself."""
        with self._lock:
            newest = dict(self._newest)
        found: dict[str, Description] = {}
        for key, arrival in newest.items():
            robot, relative = self._split(key)
            if relative == keys.DESCRIPTION:
                description = _decoded(relative, arrival)
                if isinstance(description, Description):
                    found[robot] = description
        return found

    def is_known(self, key: str) -> bool:
        """Whether a key is one of a robot's that are published."""
        row = keys.row_at(self._split(key)[1])
        return row is not None and row.kind in ("stream", "latched")

    def _split(self, key: str) -> tuple[str, str]:
        """Robot and key relative to it; for keys that belong to none, an empty name."""
        if self._namespace is not None:
            return self._namespace, key
        return keys.split_namespace(key) or ("", key)


def _middle_and_most(values: list[float]) -> tuple[float | None, float | None]:
    """Median and 99th percentile; None without values."""
    if not values:
        return None, None
    return statistics.median(values), sorted(values)[min(int(0.99 * len(values)), len(values) - 1)]


def _rhythm(times: list[int]) -> dict[str, float | None]:
    gaps_ms = [(b - a) * 1e-6 for a, b in itertools.pairwise(times)]
    if not gaps_ms or sum(gaps_ms) == 0:
        return {"rate_hz": None, "jitter_ms": None, "gap_max_ms": None}
    return {
        "rate_hz": 1e3 / statistics.fmean(gaps_ms),
        "jitter_ms": statistics.pstdev(gaps_ms),
        "gap_max_ms": max(gaps_ms),
    }


def _decoded(relative: str, arrival: Arrival) -> Any:
    """The message; or why there is none."""
    message = keys.message_at(relative)
    if message is None:
        return "not in the key space"
    try:
        return decoder_of(message).decode(arrival.payload, arrival.encoding)
    except WireError as error:
        return error.reason


def _read(arrivals: list[Arrival], message: type[Message]) -> list[tuple[Any, int]]:
    found: list[tuple[Any, int]] = []
    for arrival in arrivals:
        try:
            found.append((decoder_of(message).decode(arrival.payload, arrival.encoding), arrival.monotonic_ns))
        except WireError:
            continue
    return found

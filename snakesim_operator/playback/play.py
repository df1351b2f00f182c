"""Plays a recording on a Zenoh network of its own, with its timing: for programs that read the robot's keys.

The player is no robot: no host answers, and nothing can be armed. So it listens on an endpoint that no robot uses.
"""

import heapq
import time
from collections.abc import Iterator
from itertools import count, groupby
from pathlib import Path
from typing import Any

from snakesim_hal.base.terminal import PrintLine
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import Publisher
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES, format_encoding
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.recording_contents import read_recording

MAX_PAUSE_S = 10.0  # between two messages, whatever their times are
# An image may arrive this long after the clock message that names it.
REORDER_WINDOW_NS = 1_000_000_000
ORDER_WITHIN_TICK = {keys.CLOCK: 1, keys.APPLIED: 2}  # samples come first


def iterate_in_robot_time_order(reader: RecordingReader) -> Iterator[RecordedMessage]:
    """Yield all messages in the order of robot time: samples of a tick, then its clock, then its applied setpoints.

    The file contains them in the order of their arrival, in which the messages of one tick may be mixed.
    """
    waiting: list[tuple[int, int, int, RecordedMessage]] = []
    arrival_number = count()
    clock_ns = 0
    for recorded in reader.read_messages():
        rank = ORDER_WITHIN_TICK.get(recorded.key, 0)
        heapq.heappush(waiting, (recorded.robot_time_ns, rank, next(arrival_number), recorded))
        if recorded.key == keys.CLOCK:
            clock_ns = recorded.robot_time_ns
        while waiting[0][0] < clock_ns - REORDER_WINDOW_NS:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def play_recording(
    path: Path,
    lines: Iterator[str],
    print_text: PrintLine,
    *,
    endpoint: str | None,
    namespace: str | None,
    rate: float,
    step: bool,
) -> int:
    """Publish the messages of a recording once, on a Zenoh network of its own.

    Args:
        path: Path of the recording.
        lines: Lines that the user types.
        print_text: Prints a line.
        endpoint: Zenoh endpoint to listen on; None for the default endpoint.
        namespace: Namespace to publish in; None for the name of the robot.
        rate: Robot time divided by wall time.
        step: Whether to play one tick at each line of input, instead of with the recorded timing.

    Returns:
        The exit code: 3 if the recording is incomplete, otherwise 0.

    Raises:
        ConfigError: The file is not a recording.
        NotConnectedError: The endpoint cannot be used.
    """
    robot = read_recording(path, (keys.DESCRIPTION,)).description
    default_namespace = robot.robot if robot is not None else "recording"
    namespace = namespace or default_namespace
    link = ConnectionSettings(
        endpoint or DEFAULT_ENDPOINT, namespace, listen=True, max_bytes=MAX_IMAGE_BYTES
    )
    reader = RecordingReader(path)
    messages = iterate_in_robot_time_order(reader)
    with open_session(link) as session:
        playback_mode = "Enter plays a tick" if step else f"{rate:g} x real time"
        print_text(
            f"playing {path} on {link.endpoint}, namespace {namespace}: {playback_mode}; Ctrl-C ends it"
        )
        player = _MessagePlayer(session)
        playback_clock = _PlaybackClock(rate)
        for time_ns, simultaneous in groupby(messages, lambda recorded: recorded.robot_time_ns):
            if step:
                print_text(f"{time_ns * 1e-9:.3f} s")
                if next(lines, None) is None:
                    break
            else:
                playback_clock.wait_until(time_ns)
            for recorded in simultaneous:
                player.publish(recorded)
        print_text(f"{player.count} messages played")
    return report_missing_data(path, reader.missing)


class _PlaybackClock:
    """Maps robot time to wall time. After a long pause, such as for lost messages, the mapping starts again."""

    def __init__(self, rate: float) -> None:
        self._rate = rate  # robot time over wall time
        self._origin: tuple[float, int] | None = None  # wall time in s and robot time in ns

    def wait_until(self, time_ns: int) -> None:
        """Wait until this robot time is due, but at most MAX_PAUSE_S."""
        if self._origin is None:
            self._origin = (time.monotonic(), time_ns)
        wall_s, robot_ns = self._origin
        wait_s = wall_s + (time_ns - robot_ns) * 1e-9 / self._rate - time.monotonic()
        time.sleep(min(max(wait_s, 0.0), MAX_PAUSE_S))
        if wait_s > MAX_PAUSE_S:
            self._origin = (time.monotonic(), time_ns)


class _MessagePlayer:
    """Publishes recorded messages, with one publisher for each key."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Publisher[Any]] = {}
        self.count = 0

    def publish(self, recorded: RecordedMessage) -> None:
        """Publish a message as it was recorded. Messages at keys that SnakeSIM does not define are ignored."""
        row = keys.find_row(recorded.key)
        if row is None or row.message is None or recorded.encoding != format_encoding(row.message):
            return
        publisher = self._publishers.get(recorded.key)
        if publisher is None:
            declare = (
                self._session.declare_latched_publisher
                if row.kind == "latched"
                else self._session.declare_publisher
            )
            publisher = declare(recorded.key, row.message)
            self._publishers[recorded.key] = publisher
        publisher.send(recorded.payload)
        self.count += 1

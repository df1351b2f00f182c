"""Plays a recording on a Zenoh network of its own, with its timing: for programs that read the robot's keys.

It is no robot: no host answers, nothing can be armed. So it listens on an endpoint where nobody else is.
"""

import time
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from snakesim_hal.base.terminal import Say
from snakesim_hal.network.session import DEFAULT_ENDPOINT, Link, Publisher, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES, encoding_of
from snakesim_operator.playback.order import in_robot_order
from snakesim_operator.recording.message import RecordedMessage
from snakesim_operator.recording.reader import RecordingReader
from snakesim_operator.results.incomplete import exit_code
from snakesim_operator.results.recorded import read_recording

LONGEST_PAUSE_S = 10.0  # between two messages, whatever their times are


def play(
    path: Path, lines: Iterator[str], say: Say, *, endpoint: str | None, namespace: str | None, rate: float, step: bool
) -> int:
    """Play it once. Raises ConfigError, NotConnectedError.

    lines: what the user types. rate: of robot time to wall time; step: one tick at each line of input.
    """
    robot = read_recording(path, (keys.DESCRIPTION,)).description
    namespace = namespace or (robot.robot if robot is not None else "recording")
    link = Link(endpoint or DEFAULT_ENDPOINT, namespace, listen=True, max_bytes=MAX_IMAGE_BYTES)
    reader = RecordingReader(path)
    messages = in_robot_order(reader)
    with open_session(link) as session:
        how = "Enter plays a tick" if step else f"{rate:g} x real time"
        say(f"playing {path} on {link.endpoint}, namespace {namespace}: {how}; Ctrl-C ends it")
        player = _Player(session)
        began: tuple[float, int] | None = None
        for time_ns, together in groupby(messages, lambda recorded: recorded.time_ns):
            if step:
                say(f"{time_ns * 1e-9:.3f} s")
                if next(lines, None) is None:
                    break
            else:
                began = began or (time.monotonic(), time_ns)
                began = _waited(began, time_ns, rate)
            for recorded in together:
                player.put(recorded)
        say(f"{player.count} messages played")
    return exit_code(path, reader.lacks)


def _waited(began: tuple[float, int], time_ns: int, rate: float) -> tuple[float, int]:
    """Wait until a robot time is due. Returns when it began; a longer pause, as of lost messages, makes that later."""
    wait_s = began[0] + (time_ns - began[1]) * 1e-9 / rate - time.monotonic()
    time.sleep(min(max(wait_s, 0.0), LONGEST_PAUSE_S))
    return began if wait_s <= LONGEST_PAUSE_S else (time.monotonic(), time_ns)


class _Player:
    def __init__(self, session: Session) -> None:
        self._session = session
        self._publishers: dict[str, Publisher[Any]] = {}
        self.count = 0

    def put(self, recorded: RecordedMessage) -> None:
        """Publish it as it was."""
        row = keys.row_at(recorded.key)
        if row is None or row.message is None or recorded.encoding != encoding_of(row.message):
            return
        publisher = self._publishers.get(recorded.key)
        if publisher is None:
            declare = self._session.latched_publisher if row.kind == "latched" else self._session.publisher
            publisher = self._publishers[recorded.key] = declare(recorded.key, row.message)
        publisher.send(recorded.payload)
        self.count += 1

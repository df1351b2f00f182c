"""`snakesim record --episodes DIR`: demonstrations, one after the other, each with what the operator says of it.

Somebody drives the robot, by `snakesim teleop`, the console or from ROS; this listens. Enter begins an episode and ends
it; then s, f or d say that it succeeded, failed, or is to be dropped; q ends. Each is a recording of its own, and a
line of EPISODES, from which `snakesim export --format lerobot` makes a data set.
"""

import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from queue import Queue

import msgspec

from snakesim_hal.base.process import on_stop_signal, stop_signals, user_name
from snakesim_hal.base.terminal import say
from snakesim_hal.network.session import Link
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.targets import RobotSelection, only_robot
from snakesim_operator.recording.process import record

EPISODES = "episodes.jsonl"
WORDS = {"s": True, "f": False, "d": None}
HELP = "Enter begins an episode and ends it; then s: it succeeded, f: it failed, d: drop it. q ends"


class EpisodeLabel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A line of EPISODES."""

    file: str  # beside it
    task: str
    success: bool
    who: str
    began: str  # UTC


class _Ended(Exception):  # noqa: N818 - no error
    """The operator has left."""


class _Keyboard:
    """Lines of the terminal, while something else goes on."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._queue: Queue[str | None] = Queue()
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()

    def _read(self, lines: Iterator[str]) -> None:
        try:
            for line in lines:
                self._queue.put(line.strip().lower())
        finally:  # also after bytes that are no text: whoever waits for a line must not wait for ever
            self._queue.put(None)

    def interrupt(self) -> None:
        """As the end of the input."""
        self._queue.put(None)

    def line(self) -> str:
        """The next one. Raises _Ended."""
        found = self._queue.get()
        if found is None or found == "q":
            raise _Ended
        return found

    def pressed(self) -> bool:
        """Whether there is a line since the last one. Raises _Ended."""
        return not self._queue.empty() and self.line() is not None


def record_demonstrations(where: RobotSelection, folder: Path, task: str, lines: Iterator[str]) -> int:
    """Until q, or the end of the input. Exit code 1 when the disk took no more. Raises SnakesimError."""
    link = replace(only_robot(where, "record"), max_bytes=MAX_IMAGE_BYTES)
    folder.mkdir(parents=True, exist_ok=True)
    keyboard = _Keyboard(lines)
    on_stop_signal(keyboard.interrupt)
    demonstrations = _Demonstrations(link, folder, task, keyboard)
    say(f"{link.namespace} on {link.endpoint}, task {task!r}, into {folder}. {HELP}")
    try:
        while not demonstrations.failure:
            keyboard.line()
            demonstrations.record_one()
    except _Ended:
        pass
    finally:
        for which in stop_signals():
            signal.signal(which, signal.SIG_DFL)
    say(f"{demonstrations.kept} episodes; `snakesim export {folder} --format lerobot` makes a data set of {folder}")
    return 1 if demonstrations.failure else 0


class _Demonstrations:
    """The episodes of one sitting."""

    def __init__(self, link: Link, folder: Path, task: str, keyboard: _Keyboard) -> None:
        self._link, self._folder, self._task, self._keyboard = link, folder, task, keyboard
        self.kept = 0
        self.failure = ""

    def record_one(self) -> None:
        """From now to Enter, and what became of it. Raises _Ended."""
        path = next(p for i in count() if not (p := self._folder / f"episode-{i:03d}.mcap").exists())
        began = datetime.now(UTC).isoformat(timespec="seconds")
        say(f"{path.name}: recording; Enter ends it")
        success = None
        try:
            recorder = record(self._link, path, lambda: not self._keyboard.pressed())
            self.failure = recorder.recording.failure
            if not self.failure:
                say(f"{path.name}: {recorder.recording.counts.total()} messages. s, f or d?")
                success = self._judgement()
        finally:
            if success is None:
                path.unlink(missing_ok=True)
                say(f"{path.name}: dropped")
        if success is not None:
            self._keep(EpisodeLabel(file=path.name, task=self._task, success=success, who=user_name(), began=began))

    def _judgement(self) -> bool | None:
        while (word := self._keyboard.line()) not in WORDS:
            say(f"{word!r}: s if it succeeded, f if it failed, d to drop it")
        return WORDS[word]

    def _keep(self, label: EpisodeLabel) -> None:
        with (self._folder / EPISODES).open("ab") as file:
            file.write(msgspec.json.encode(label) + b"\n")
        self.kept += 1
        say(f"{label.file}: {'succeeded' if label.success else 'failed'}. Enter begins the next one")

"""`snakesim record --episodes DIR`: records demonstrations one after the other, with the operator's judgment of each.

The operator drives the robot by `snakesim teleop`, the console or from ROS, while this command records. Enter begins an
episode and ends it; then s, f or d mark it as succeeded, failed, or to be dropped; q ends the command. Each episode is
a recording of its own, and a line of EPISODES, from which `snakesim recording export --format lerobot` makes a dataset.
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

from snakesim_hal.base.process import call_on_stop_signals, get_user_name, list_stop_signals
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.targets import RobotSelection, find_single_robot
from snakesim_operator.recording.recorder_process import record_to_file

LABELS_FILENAME = "episodes.jsonl"
SUCCESS_BY_KEY = {"s": True, "f": False, "d": None}  # None: the episode is dropped
KEY_HELP = (
    "Enter begins an episode and ends it; then s: it succeeded, f: it failed, d: drop it. q ends"
)


class EpisodeLabel(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The label of one episode: a line of the file LABELS_FILENAME."""

    file: str  # name of the recording in the same folder
    task: str
    success: bool
    recorded_by: str
    began: str  # UTC


class _InputEnded(Exception):  # noqa: N818 - no error
    """The input has ended, or the operator has typed q."""


class _LineReader:
    """Reads lines of the terminal in a thread while the main thread records."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._queue: Queue[str | None] = Queue()
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()

    def _read(self, lines: Iterator[str]) -> None:
        try:
            for line in lines:
                self._queue.put(line.strip().lower())
        finally:  # also after bytes that are no text: the main thread must not wait for ever
            self._queue.put(None)

    def end_input(self) -> None:
        """End the input, as if the terminal had been closed."""
        self._queue.put(None)

    def next_line(self) -> str:
        """Wait for the next line and return it. Raises _InputEnded."""
        line = self._queue.get()
        if line is None or line == "q":
            raise _InputEnded
        return line

    def pop_line_if_any(self) -> bool:
        """Remove a line if one has arrived, and return whether one had arrived. Raises _InputEnded."""
        if self._queue.empty():
            return False
        self.next_line()
        return True


def record_demonstrations(
    selection: RobotSelection, folder: Path, task: str, lines: Iterator[str]
) -> int:
    """Record episodes that an operator demonstrates, until the operator types q or the input ends.

    A full disk ends the command as well. A stop signal counts as the end of the input.

    Args:
        selection: The robot to record.
        folder: Folder for the recordings; created if it does not exist.
        task: The task that the operator demonstrates, in words.
        lines: Lines that the operator types.

    Returns:
        The exit code: 1 if the disk was full, otherwise 0.

    Raises:
        SnakesimError: The robot cannot be recorded.
    """
    link = replace(find_single_robot(selection, "record"), max_bytes=MAX_IMAGE_BYTES)
    folder.mkdir(parents=True, exist_ok=True)
    keyboard = _LineReader(lines)
    call_on_stop_signals(keyboard.end_input)
    demonstrations = _DemonstrationRecorder(link, folder, task, keyboard)
    print_line(f"{link.namespace} on {link.endpoint}, task {task!r}, into {folder}. {KEY_HELP}")
    try:
        while not demonstrations.failure:
            keyboard.next_line()  # Enter begins an episode
            demonstrations.record_episode()
    except _InputEnded:
        pass
    finally:
        for number in list_stop_signals():
            signal.signal(number, signal.SIG_DFL)
    print_line(
        f"{demonstrations.saved_count} episodes; `snakesim recording export {folder} --format lerobot` makes a dataset "
        f"of {folder}"
    )
    return 1 if demonstrations.failure else 0


class _DemonstrationRecorder:
    """Records episodes one after another into a folder, each with its label."""

    def __init__(
        self, connection: ConnectionSettings, folder: Path, task: str, keyboard: _LineReader
    ) -> None:
        self._connection = connection
        self._folder = folder
        self._task = task
        self._keyboard = keyboard
        self.saved_count = 0
        self.failure = ""

    def record_episode(self) -> None:
        """Record one episode until Enter, and keep it unless the operator drops it.

        The file is deleted if the operator drops the episode, if the input ends, or if recording fails.

        Raises:
            _InputEnded: The operator ended the command before judging the episode.
        """
        path = self._find_free_path()
        start_time_utc = datetime.now(UTC).isoformat(timespec="seconds")
        print_line(f"{path.name}: recording; Enter ends it")
        success = None  # as judged by the operator; None: drop the episode
        try:
            recorder = record_to_file(
                self._connection, path, lambda: not self._keyboard.pop_line_if_any()
            )
            self.failure = recorder.writer.failure
            if not self.failure:
                message_count = recorder.writer.counts.total()
                print_line(f"{path.name}: {message_count} messages. s, f or d?")
                success = self._read_success()
        finally:
            if success is None:
                path.unlink(missing_ok=True)
                print_line(f"{path.name}: dropped")
        if success is not None:
            label = EpisodeLabel(
                file=path.name,
                task=self._task,
                success=success,
                recorded_by=get_user_name(),
                began=start_time_utc,
            )
            self._append_label(label)

    def _find_free_path(self) -> Path:
        """Return the first numbered path at which there is no recording yet."""
        for number in count():
            path = self._folder / f"episode-{number:03d}.mcap"
            if not path.exists():
                return path
        raise AssertionError("count() does not end")

    def _read_success(self) -> bool | None:
        """Wait for the judgment of the operator. Returns whether the episode succeeded, or None to drop it."""
        while True:
            key = self._keyboard.next_line()
            if key in SUCCESS_BY_KEY:
                return SUCCESS_BY_KEY[key]
            print_line(f"{key!r}: s if it succeeded, f if it failed, d to drop it")

    def _append_label(self, label: EpisodeLabel) -> None:
        """Append the label of an episode to the labels of the folder."""
        with (self._folder / LABELS_FILENAME).open("ab") as file:
            file.write(msgspec.json.encode(label) + b"\n")
        self.saved_count += 1
        result = "succeeded" if label.success else "failed"
        print_line(f"{label.file}: {result}. Enter begins the next one")

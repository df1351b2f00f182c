"""Writes the supervisor's files into the run's folder, in a separate thread: a robot never waits for a disk.

Failed writes stay in bounded memory and are retried. Lost data is reported.
"""

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.workers import start_restarting_thread

MAX_PENDING_BYTES = 8 * 2**20
# Of one log, so that a process with endless output does not fill the disk.
MAX_LOG_BYTES = 64 * 2**20
MAX_MERGED_BYTES = 2**16  # pending appends are merged up to this size
RETRY_PERIOD_S = 0.5
DISK_TIMEOUT_S = 5.0  # for a disk that hangs


@dataclass
class _FileOperation:
    """One operation on a file. For a rename, `content` is the new name."""

    kind: Literal["append", "put", "rename"]
    name: str
    content: bytes

    def can_merge(self, other: "_FileOperation") -> bool:
        """Return whether the content of another task can be added to this one."""
        appends_to_same_file = self.kind == other.kind == "append" and self.name == other.name
        return appends_to_same_file and len(self.content) < MAX_MERGED_BYTES


class RunFiles:
    """Writes the files of one run in a thread, in order. Only `wait_until_written` and `close` wait for the disk."""

    def __init__(self, folder: Path | None, warn: Callable[[str], None]) -> None:
        """Start the thread that writes the files.

        Args:
            folder: Folder of the run; None to write no files.
            warn: Called once, from another thread, if a file cannot be written.
        """
        self.folder = folder
        self._warn = warn
        self._failure = ""  # of the last attempt
        self._warned = False
        self._lost = ""  # why data was lost
        self._tasks: deque[_FileOperation] = deque()
        self._waiting_bytes = 0
        self._appended: dict[str, int] = {}  # bytes, by name
        self._handles: dict[str, int] = {}
        self._closing = False
        self._changed = threading.Condition()
        self._thread = start_restarting_thread("files", self._write_files, on_error=self._drop_task)

    def append(self, name: str, content: bytes) -> None:
        """Append to a file. The content is dropped if the file or the pending data is too large."""
        appended_bytes = self._appended.get(name, 0) + len(content)
        if appended_bytes > MAX_LOG_BYTES:
            self._lost = (
                self._lost
                or f"{name} is longer than {MAX_LOG_BYTES >> 20} MiB: the rest of it is lost"
            )
            return
        self._appended[name] = appended_bytes
        self._add_task(_FileOperation("append", name, content))

    def write_file(self, name: str, content: bytes) -> None:
        """Write a whole file atomically, in place of an earlier one."""
        self._add_task(_FileOperation("put", name, content))

    def rename(self, name: str, to: str) -> None:
        """Rename a file that was appended to; later appends start a new file."""
        self._appended.pop(name, None)
        self._add_task(_FileOperation("rename", name, to.encode()))

    def warn(self, failure: str) -> None:
        """Warn once that a file cannot be written, by this or another process."""
        if not self._warned:
            self._warned = True
            self._warn(failure)

    def wait_until_written(self) -> None:
        """Wait until everything is written, until writing fails, or for DISK_TIMEOUT_S."""
        with self._changed:
            self._changed.wait_for(lambda: not self._tasks or self._failure, DISK_TIMEOUT_S)

    def close(self) -> str:
        """Retry all pending writes once, and stop the thread.

        Returns:
            Why data was lost; empty if no data was lost.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(DISK_TIMEOUT_S)
        if self._thread.is_alive():
            return f"{self.folder}: the disk has not answered for {DISK_TIMEOUT_S:g} s"
        return self._lost

    def _add_task(self, task: _FileOperation) -> None:
        with self._changed:
            if self.folder is None:
                return
            if self._waiting_bytes + len(task.content) > MAX_PENDING_BYTES:
                self._lost = (
                    self._failure or f"{self.folder}: the disk is too slow for the run's output"
                )
                return
            if len(self._tasks) > 1 and self._tasks[-1].can_merge(
                task
            ):  # the first one may be in progress
                self._tasks[-1].content += task.content
            else:
                self._tasks.append(task)
            self._waiting_bytes += len(task.content)
            self._changed.notify_all()

    def _write_files(self) -> None:
        """Carry out the write tasks in order, until the files are closed and no task is left. Runs in a thread.

        A failed task is retried after RETRY_PERIOD_S. Once the files are being closed, it is dropped instead.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._tasks or self._closing)
                if not self._tasks:
                    break
                task = self._tasks[0]
            bytes_before = len(task.content)
            self._failure = self._try_task(task)  # without the lock, because writing may take long
            if self._failure:
                self.warn(self._failure)
            with self._changed:
                is_done = not self._failure or self._closing
                if is_done:
                    self._tasks.popleft()
                    self._waiting_bytes -= bytes_before
                    self._lost = self._lost or self._failure
                else:
                    written_bytes = bytes_before - len(task.content)
                    self._waiting_bytes -= written_bytes
                    self._changed.notify_all()
                    self._changed.wait_for(lambda: self._closing, RETRY_PERIOD_S)
                self._changed.notify_all()
        for handle in self._handles.values():
            os.close(handle)

    def _drop_task(self, error: Exception) -> None:
        """Drop a task that raised an unexpected error, because it would raise the error again and delay other tasks."""
        with self._changed:
            if self._tasks:
                task = self._tasks.popleft()
                self._waiting_bytes -= len(task.content)
                self._lost = self._lost or f"{self.folder}: {task.name} was not written: {error}"
            self._changed.notify_all()

    def _try_task(self, task: _FileOperation) -> str:
        """Try to carry out a task. The unwritten rest of an append stays in the task.

        Returns:
            The error as text; empty if the task succeeded.
        """
        assert self.folder is not None
        try:
            if task.kind == "append":
                self._append(self.folder, task)
            elif task.kind == "put":
                write_atomically(self.folder / task.name, task.content)
            elif task.name in self._handles:
                os.close(self._handles.pop(task.name))
                (self.folder / task.name).rename(self.folder / task.content.decode())
        except OSError as error:
            return f"{self.folder}: {error.strerror}"
        return ""

    def _append(self, folder: Path, task: _FileOperation) -> None:
        """Append the content of a task to its file. A new file that stays empty on a full disk is removed."""
        path = folder / task.name
        if task.name not in self._handles:
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
            self._handles[task.name] = os.open(path, flags, 0o644)
        handle = self._handles[task.name]
        try:
            while task.content:
                written_bytes = os.write(handle, task.content)
                task.content = task.content[written_bytes:]
        except OSError:
            if os.fstat(handle).st_size == 0:
                os.close(self._handles.pop(task.name))
                with contextlib.suppress(OSError):
                    path.unlink()
            raise

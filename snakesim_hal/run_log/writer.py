"""Writes the record of a host while it runs: black box, description and statistics.

A failed write is retried each time, for as long as the black box keeps the rows. The statistics also go to `memory`, an
in-memory file shared with the parent process: they are known there when the disk is full or hangs, and after a SIGKILL.

Threads: the thread `recorder` writes, twice a second, so no tick waits for a disk. The host's main thread starts it
with `with`, and at the end waits for it.
"""

import contextlib
import errno
import os
import threading
from itertools import count
from pathlib import Path
from typing import Protocol, Self

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD
from snakesim_hal.wire.messages import RobotDescription

WRITE_PERIOD_S = 0.5
CLOSE_TIMEOUT_S = 2.0  # for a disk that hangs


class StatisticsFactory(Protocol):
    """Makes a message of the host's statistics, at any time and from any thread."""

    def __call__(self, *, lost_ticks: int, failure: str) -> msgspec.Struct:
        """Return the statistics of the host.

        Args:
            lost_ticks: Number of rows that are missing from the file for good.
            failure: Which file cannot be written, and why. Empty if all can be written.
        """
        ...


class HostRecordWriter:
    """Writes the record of one host into the folder of a run, for as long as a `with` block lasts."""

    def __init__(
        self,
        black_box: BlackBox,
        description: RobotDescription,
        make_statistics: StatisticsFactory,
        folder: Path | None,
        memory_fd: int | None = None,
    ) -> None:
        """Prepare the writer. Its thread starts when the `with` block is entered.

        Args:
            black_box: Black box whose rows are written.
            description: Description of the robot, which is written to a file of its own.
            make_statistics: Function that returns the host's statistics.
            folder: Folder of the run. None writes no files.
            memory_fd: File descriptor of an in-memory file for the statistics. None if there is no such file.
        """
        # What is written, and where.
        self._black_box = black_box
        self._description = description
        self._make_statistics = make_statistics
        self._folder = folder
        self._memory_fd = memory_fd
        # The black box file. Only the writing thread changes these.
        self._black_box_fd: int | None = None  # None until the file is created
        self._first_row_offset_bytes = 0  # in the file
        self._next_row = 0  # the first row that is not in the file yet
        self._skipped_row_count = 0  # rows that were overwritten before they were written to disk
        # Which file could not be written, and why; empty after a successful write.
        self._failure = ""
        # The thread.
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        if self._memory_fd is not None:
            os.ftruncate(self._memory_fd, 0)  # of an earlier host
        self._thread = start_restarting_thread(
            "recorder", self._write_periodically, should_stop=self._closing.is_set
        )
        return self

    def __exit__(self, *_error: object) -> None:
        """Write the remaining rows and the final statistics. A disk that hangs is waited for up to CLOSE_TIMEOUT_S."""
        self._closing.set()
        assert self._thread is not None
        self._thread.join(CLOSE_TIMEOUT_S)
        if self._thread.is_alive():
            self._set_failure(
                f"{self._folder}: the disk has not answered for {CLOSE_TIMEOUT_S:g} s"
            )
            self._write_statistics_to_memory()

    def _write_periodically(self) -> None:
        """Write twice a second, and once more at the end, in the writing thread."""
        closing = False
        while not closing:
            closing = self._closing.wait(WRITE_PERIOD_S)
            if self._folder is not None:
                self._set_failure(self._write_files(self._folder))
            self._write_statistics_to_memory()
        if self._black_box_fd is not None:
            os.close(self._black_box_fd)

    def _write_files(self, folder: Path) -> str:
        """Write new rows and the statistics into a folder.

        Returns:
            Which file could not be written, and why. Empty if all were written.
        """
        failure = ""
        for write in (self._write_rows, self._write_statistics):
            try:
                write(folder, failure)
            except OSError as error:
                if not failure:
                    failure = f"{folder}: {error.strerror or error}"
        return failure

    def _write_statistics(self, folder: Path, failure: str) -> None:
        """Write the statistics, with this failure in them, to a file of the folder. Raises OSError."""
        # The file in the folder is an earlier host's, and must not be overwritten.
        if self._black_box_fd is None:
            return
        content = msgspec.json.encode(self._collect_statistics(failure))
        write_atomically(folder / HOST_RECORD, msgspec.json.format(content))

    def _create_files(self, folder: Path) -> int:
        """Rename the files of an earlier host in this folder, and create the files of this host.

        Returns:
            File descriptor of the black box file, which contains only the header yet.
        """
        if (folder / HOST_RECORD).exists() or (folder / BLACK_BOX).exists():
            number = next(n for n in count(1) if not _insert_number(folder / BLACK_BOX, n).exists())
            for path in (folder / BLACK_BOX, folder / HOST_RECORD):
                with contextlib.suppress(FileNotFoundError):
                    path.rename(_insert_number(path, number))
        write_atomically(folder / DESCRIPTION, msgspec.json.encode(self._description))
        header = self._black_box.layout.encode_header()
        write_atomically(folder / BLACK_BOX, header)
        self._first_row_offset_bytes = len(header)
        return os.open(folder / BLACK_BOX, os.O_WRONLY | os.O_CLOEXEC)

    def _write_rows(self, folder: Path, _failure: str) -> None:
        """Append the new rows of the black box to the file, which is created at the first call.

        Rows that were overwritten in the ring buffer before they could be written are counted as skipped.

        Args:
            folder: Folder of the run.
            _failure: Not used. All functions that `_write_files` calls have this argument.

        Raises:
            OSError: The file cannot be created, or the disk is full.
        """
        if self._black_box_fd is None:
            self._black_box_fd = self._create_files(folder)
        row_bytes = self._black_box.layout.row_bytes
        # Later rows wait for the next call, because a slow disk may never catch up with a host that keeps recording.
        end_row = self._black_box.row_count
        while self._next_row < end_row:
            first_row, rows = self._black_box.read_rows(self._next_row)
            self._skipped_row_count += first_row - self._next_row
            self._next_row = first_row
            offset = (
                self._first_row_offset_bytes
                + (self._next_row - self._skipped_row_count) * row_bytes
            )
            written_bytes = os.pwrite(self._black_box_fd, rows, offset)
            # An incomplete row is written again next time.
            self._next_row += written_bytes // row_bytes
            if written_bytes < len(rows):  # a disk that runs full stores a part first
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _set_failure(self, failure: str) -> None:
        """Store which write has failed (empty if none has), and print the first failure of a series."""
        if failure and not self._failure:
            print_stderr(f"record: {failure}")
        self._failure = failure

    def _collect_statistics(self, failure: str) -> msgspec.Struct:
        """Return the host's statistics. At the end, rows that were not written to disk count as lost."""
        lost_ticks = self._skipped_row_count
        if self._closing.is_set():
            lost_ticks += self._black_box.row_count - self._next_row
        return self._make_statistics(lost_ticks=lost_ticks, failure=failure)

    def _write_statistics_to_memory(self) -> None:
        """Write the statistics into the in-memory file."""
        if self._memory_fd is None:
            return
        content = msgspec.json.encode(self._collect_statistics(self._failure))
        with contextlib.suppress(OSError):  # no memory left: then only the folder has them
            os.pwrite(self._memory_fd, content, 0)
            os.ftruncate(self._memory_fd, len(content))


def _insert_number(path: Path, number: int) -> Path:
    """Return the path of a file with a number behind the stem of its name."""
    return path.with_stem(f"{path.stem}-{number}")

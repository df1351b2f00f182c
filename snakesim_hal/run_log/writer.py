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
from snakesim_hal.base.workers import start_worker
from snakesim_hal.run_log.black_box import BlackBox
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD
from snakesim_hal.wire.messages import Description

PERIOD_S = 0.5
CLOSE_LIMIT_S = 2.0  # for a disk that hangs


class Numbers(Protocol):
    """Makes a message of the host's statistics, at any time and from any thread."""

    def __call__(self, *, lost_ticks: int, failure: str) -> msgspec.Struct:
        """lost_ticks: rows missing from the file for good; failure: which file cannot be written, and why, or empty."""
        ...


class HostRecordWriter:
    """Writes into one run's folder, from `with` on until its end."""

    def __init__(
        self, box: BlackBox, description: Description, numbers: Numbers, folder: Path | None, memory: int | None = None
    ) -> None:
        """Prepare the writer; the writing thread starts when the context is entered.

        Args:
            box: the black box with the rows.
            description: description of the robot, which gets a file of its own.
            numbers: function that returns the host's statistics.
            folder: folder of the run; None: no files are written.
            memory: file descriptor of an in-memory file for the statistics; None: there is no such file.
        """
        # What is written, and where.
        self._box = box
        self._description = description
        self._numbers = numbers
        self._folder = folder
        self._memory = memory
        # The black box file. Only the writing thread changes these.
        self._file: int | None = None  # descriptor; None: not created yet
        self._rows_offset = 0  # of the first row in the file, in bytes
        self._next_row = 0  # the first row that is not in the file yet
        self._skipped_rows = 0  # overwritten before they were written to disk
        self._failure = ""
        # The thread.
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        if self._memory is not None:
            os.ftruncate(self._memory, 0)  # of an earlier host
        self._thread = start_worker("recorder", self._run, is_over=self._closing.is_set)
        return self

    def __exit__(self, *_error: object) -> None:
        """Write the rest and the final statistics. Waits for a hanging disk no longer than CLOSE_LIMIT_S."""
        self._closing.set()
        assert self._thread is not None
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            self._note(f"{self._folder}: the disk has not answered for {CLOSE_LIMIT_S:g} s")
            self._update_memory()

    def _run(self) -> None:
        """Write twice a second, and once more at the end, in the writing thread."""
        closing = False
        while not closing:
            closing = self._closing.wait(PERIOD_S)
            if self._folder is not None:
                self._note(self._update_folder(self._folder))
            self._update_memory()
        if self._file is not None:
            os.close(self._file)

    def _update_folder(self, folder: Path) -> str:
        """Write everything that is new. Returns which file could not be written, and why; empty: none."""
        failure = ""
        for write in (self._write_rows, self._write_numbers):
            try:
                write(folder, failure)
            except OSError as error:
                if not failure:
                    failure = f"{folder}: {error.strerror or error}"
        return failure

    def _write_numbers(self, folder: Path, failure: str) -> None:
        if self._file is None:  # the file in the folder is an earlier host's, and must not be overwritten
            return
        content = msgspec.json.encode(self._make_statistics(failure))
        write_atomically(folder / HOST_RECORD, msgspec.json.format(content))

    def _open(self, folder: Path) -> int:
        """Create the files of this host; those of an earlier one in this run get a number."""
        if (folder / HOST_RECORD).exists() or (folder / BLACK_BOX).exists():
            number = next(n for n in count(1) if not _numbered(folder / BLACK_BOX, n).exists())
            for path in (folder / BLACK_BOX, folder / HOST_RECORD):
                with contextlib.suppress(FileNotFoundError):
                    path.rename(_numbered(path, number))
        write_atomically(folder / DESCRIPTION, msgspec.json.encode(self._description))
        header = self._box.layout.header()
        write_atomically(folder / BLACK_BOX, header)
        self._rows_offset = len(header)
        return os.open(folder / BLACK_BOX, os.O_WRONLY | os.O_CLOEXEC)

    def _write_rows(self, folder: Path, _failure: str) -> None:
        """Append the new rows of the black box to its file, and create the file at the first call.

        Rows that the ring of the black box has overwritten before they could be written are counted as skipped.

        Args:
            folder: the folder of the run.

        Raises:
            OSError: the file cannot be created, or the disk is full.
        """
        if self._file is None:
            self._file = self._open(folder)
        row_bytes = self._box.layout.row_bytes
        # Later rows wait for the next call, because a slow disk may never catch up with a host that keeps recording.
        end_row = self._box.ticks
        while self._next_row < end_row:
            first_row, rows = self._box.read_rows(self._next_row)
            self._skipped_rows += first_row - self._next_row
            self._next_row = first_row
            offset = self._rows_offset + (self._next_row - self._skipped_rows) * row_bytes
            written_bytes = os.pwrite(self._file, rows, offset)
            self._next_row += written_bytes // row_bytes  # an incomplete row is written again next time
            if written_bytes < len(rows):  # a disk that runs full stores a part first
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _note(self, failure: str) -> None:
        """Keep the present failure, and print the first of a series."""
        if failure and not self._failure:
            print_stderr(f"record: {failure}")
        self._failure = failure

    def _make_statistics(self, failure: str) -> msgspec.Struct:
        lost_ticks = self._skipped_rows
        if self._closing.is_set():
            lost_ticks += self._box.ticks - self._next_row
        return self._numbers(lost_ticks=lost_ticks, failure=failure)

    def _update_memory(self) -> None:
        """Write the statistics into the in-memory file."""
        if self._memory is None:
            return
        content = msgspec.json.encode(self._make_statistics(self._failure))
        with contextlib.suppress(OSError):  # no memory left: then only the folder has them
            os.pwrite(self._memory, content, 0)
            os.ftruncate(self._memory, len(content))


def _numbered(path: Path, number: int) -> Path:
    return path.with_stem(f"{path.stem}-{number}")

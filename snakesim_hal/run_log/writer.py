"""Writes the record of a host while it runs: black box, description and statistics.

A separate thread writes, twice a second, so no tick waits for a disk. A failed write is retried each
time, for as long as the black box keeps the rows. The statistics also go to `memory`, an in-memory file shared with the
parent process: they are known there when the disk is full or hangs, and after a SIGKILL.
"""

import contextlib
import errno
import os
import threading
from itertools import count
from pathlib import Path
from typing import Protocol, Self

import msgspec

from snakesim_hal.base.atomic_write import write_whole
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
        """folder: None for no files; memory: a file descriptor, see above."""
        self._box, self._description, self._numbers = box, description, numbers
        self._folder, self._memory = folder, memory
        self._file: int | None = None
        self._begins = 0  # offset of the first row in the file
        self._next = 0  # the first row that is not in the file yet
        self._skipped = 0  # rows that were overwritten before they were written to disk
        self._failure = ""
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        if self._memory is not None:
            os.ftruncate(self._memory, 0)  # of an earlier host
        self._thread = start_worker("recorder", self._run, is_over=self._closing.is_set)
        return self

    def __exit__(self, *_error: object) -> None:
        """Write the rest, and how the host ended. Waits for a hanging disk no longer than CLOSE_LIMIT_S."""
        self._closing.set()
        assert self._thread is not None
        self._thread.join(CLOSE_LIMIT_S)
        if self._thread.is_alive():
            self._note(f"{self._folder}: the disk has not answered for {CLOSE_LIMIT_S:g} s")
            self._remember()

    def _run(self) -> None:
        closing = False
        while not closing:
            closing = self._closing.wait(PERIOD_S)
            if self._folder is not None:
                self._note(self._written(self._folder))
            self._remember()
        if self._file is not None:
            os.close(self._file)

    def _written(self, folder: Path) -> str:
        """Bring the folder up to date. Returns which file could not be written, and why."""
        failure = ""
        for write in (self._write_rows, self._write_numbers):
            try:
                write(folder, failure)
            except OSError as error:
                failure = failure or f"{folder}: {error.strerror or error}"
        return failure

    def _write_numbers(self, folder: Path, failure: str) -> None:
        if self._file is not None:  # else they would overwrite an earlier host's
            write_whole(folder / HOST_RECORD, msgspec.json.format(msgspec.json.encode(self._message(failure))))

    def _open(self, folder: Path) -> int:
        """Create the files of this host; those of an earlier one in this run get a number."""
        if (folder / HOST_RECORD).exists() or (folder / BLACK_BOX).exists():
            number = next(n for n in count(1) if not _numbered(folder / BLACK_BOX, n).exists())
            for path in (folder / BLACK_BOX, folder / HOST_RECORD):
                with contextlib.suppress(FileNotFoundError):
                    path.rename(_numbered(path, number))
        write_whole(folder / DESCRIPTION, msgspec.json.encode(self._description))
        header = self._box.layout.header()
        write_whole(folder / BLACK_BOX, header)
        self._begins = len(header)
        return os.open(folder / BLACK_BOX, os.O_WRONLY | os.O_CLOEXEC)

    def _write_rows(self, folder: Path, _failure: str) -> None:
        if self._file is None:
            self._file = self._open(folder)
        size = self._box.layout.row_bytes
        end = self._box.ticks  # now: a slow disk may never catch up with a host that goes on
        while self._next < end:
            first, rows = self._box.rows_from(self._next)
            self._skipped += first - self._next
            self._next = first
            written = os.pwrite(self._file, rows, self._begins + (self._next - self._skipped) * size)
            self._next += written // size  # an incomplete row is written again next time
            if written < len(rows):  # a full disk first takes a part
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _note(self, failure: str) -> None:
        if failure and not self._failure:
            print_stderr(f"record: {failure}")
        self._failure = failure

    def _message(self, failure: str) -> msgspec.Struct:
        lost = self._skipped + (self._box.ticks - self._next if self._closing.is_set() else 0)
        return self._numbers(lost_ticks=lost, failure=failure)

    def _remember(self) -> None:
        if self._memory is not None:
            content = msgspec.json.encode(self._message(self._failure))
            with contextlib.suppress(OSError):  # no memory left: then only the folder has them
                os.pwrite(self._memory, content, 0)
                os.ftruncate(self._memory, len(content))


def _numbered(path: Path, number: int) -> Path:
    return path.with_stem(f"{path.stem}-{number}")

"""The files of a run, which a supervisor writes in the background.

They are written in order, no caller waits for the disk, and a loss is reported.
"""

import errno
import os
import time
from pathlib import Path
from threading import Event

import pytest

from snakesim_operator.run import run_files as under_test
from snakesim_operator.run.run_files import RunFiles
from snakesim_testing.harness.wait import wait_until

HANG_S = 30.0
ROOM_BYTES = 2**30  # more than a test writes


class FaultyDisk:
    """A disk with a limited number of free bytes, which hangs on request."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free_bytes = ROOM_BYTES
        self.hangs = False
        self.answers = Event()  # set: calls that hang continue
        self._real_write = os.write
        self._real_write_atomically = under_test.write_atomically
        monkeypatch.setattr(under_test.os, "write", self.write)
        monkeypatch.setattr(under_test, "write_atomically", self.write_atomically)
        monkeypatch.setattr(under_test, "RETRY_PERIOD_S", 0.02)
        monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 0.3)

    def _allocate(self, size: int) -> int:
        """Return how many bytes of this size still have room on the disk."""
        if self.hangs:
            self.answers.wait(HANG_S)
        if self.free_bytes == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        allocated = min(size, self.free_bytes)
        self.free_bytes -= allocated
        return allocated

    def write(self, handle: int, content: bytes) -> int:
        """Write as much as has room, as `os.write` does."""
        return self._real_write(handle, content[: self._allocate(len(content))])

    def write_atomically(self, path: Path, content: bytes) -> None:
        """Write a file, or nothing if it does not have room."""
        if self._allocate(len(content)) < len(content):
            raise OSError(errno.ENOSPC, "No space left on device")
        self._real_write_atomically(path, content)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> FaultyDisk:
    return FaultyDisk(monkeypatch)


def test_run_files_are_written_in_order_after_settling(tmp_path: Path) -> None:
    warnings: list[str] = []
    files = RunFiles(tmp_path, warnings.append)
    for i in range(1000):
        files.append("a.log", b"%d\n" % i)
        files.append("b.log", b"%d\n" % -i)
    files.rename("a.log", "a-1.log")
    files.rename(
        "never.log", "never-1.log"
    )  # no task appended to this file, so there is nothing to rename
    files.append("a.log", b"new\n")
    files.write_file("whole.json", b"{}")
    files.wait_until_written()
    assert (tmp_path / "a-1.log").read_bytes() == b"".join(b"%d\n" % i for i in range(1000))
    assert (tmp_path / "a.log").read_bytes() == b"new\n"
    assert (tmp_path / "whole.json").read_bytes() == b"{}"
    assert files.close() == ""
    assert warnings == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a-1.log",
        "a.log",
        "b.log",
        "whole.json",
    ]


def test_run_files_are_complete_when_full_disk_gets_room(
    tmp_path: Path, disk: FaultyDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 60.0)
    warnings: list[str] = []
    files = RunFiles(tmp_path, warnings.append)
    disk.free_bytes = 10
    files.append("a.log", b"0123456789abcdef")
    files.write_file("whole.json", b"{}")
    wait_until(lambda: warnings, "a warning")
    assert (tmp_path / "a.log").read_bytes() == b"0123456789"
    start_s = time.monotonic()
    files.wait_until_written()
    assert time.monotonic() - start_s < 30.0  # not the whole timeout, because writing has failed
    disk.free_bytes = ROOM_BYTES
    wait_until(lambda: (tmp_path / "whole.json").exists(), "the second file")
    assert (tmp_path / "a.log").read_bytes() == b"0123456789abcdef"
    assert files.close() == ""
    assert warnings == [f"{tmp_path}: No space left on device"]


def test_run_files_on_full_disk_are_absent_and_reported(tmp_path: Path, disk: FaultyDisk) -> None:
    warnings: list[str] = []
    files = RunFiles(tmp_path, warnings.append)
    disk.free_bytes = 0
    for i in range(100):
        files.append("a.log", b"%d\n" % i)
    files.write_file("whole.json", b"{}")
    wait_until(lambda: warnings, "a warning")
    assert files.close() == f"{tmp_path}: No space left on device"
    assert len(warnings) == 1
    assert list(tmp_path.iterdir()) == []


def test_run_files_on_hanging_disk_never_block_and_bound_memory(
    tmp_path: Path, disk: FaultyDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "MAX_PENDING_BYTES", 10_000)
    files = RunFiles(tmp_path, lambda _: None)
    disk.hangs = True
    start_s = time.monotonic()
    for _ in range(1000):
        files.append("a.log", b"x" * 100)
    assert sum(len(task.content) for task in files._tasks) <= 10_000
    assert files.close() == f"{tmp_path}: the disk has not answered for 0.3 s"
    assert time.monotonic() - start_s < HANG_S / 2  # no caller waited for the disk
    disk.answers.set()


def test_run_files_too_fast_for_slow_disk_report_loss(
    tmp_path: Path, disk: FaultyDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "MAX_PENDING_BYTES", 10_000)
    monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 5.0)
    files = RunFiles(tmp_path, lambda _: None)
    disk.hangs = True
    for i in range(200):
        files.append("a.log", b"%099d\n" % i)
    disk.hangs = False
    disk.answers.set()
    assert files.close() == f"{tmp_path}: the disk is too slow for the run's output"
    kept = (tmp_path / "a.log").read_bytes().splitlines()
    assert [int(line) for line in kept] == list(range(100))


def test_run_files_without_folder_are_not_kept() -> None:
    files = RunFiles(None, pytest.fail)
    files.append("a.log", b"x")
    files.write_file("whole.json", b"{}")
    files.wait_until_written()
    assert files.close() == ""


def test_run_log_above_size_limit_is_cut_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "MAX_LOG_BYTES", 2 * 2**20)
    files = RunFiles(tmp_path, lambda _: None)
    for _ in range(300):
        files.append("a.log", b"x" * 10_000)
        files.wait_until_written()
    files.append("b.log", b"x")
    assert files.close() == "a.log is longer than 2 MiB: the rest of it is lost"
    assert (tmp_path / "a.log").stat().st_size == 2_090_000
    assert (tmp_path / "b.log").read_bytes() == b"x"

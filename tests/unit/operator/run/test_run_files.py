"""What a supervisor writes: in order, never waited for, kept while the disk is full, and told when it is lost."""

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


class Disk:
    """A disk that takes so many bytes more, or hangs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.space, self.hangs, self.goes_on = 2**30, False, Event()
        self._write, self._whole = os.write, under_test.write_atomically
        monkeypatch.setattr(under_test.os, "write", self.write)
        monkeypatch.setattr(under_test, "write_atomically", self.write_whole)
        monkeypatch.setattr(under_test, "RETRY_PERIOD_S", 0.02)
        monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 0.3)

    def _take(self, size: int) -> int:
        if self.hangs:
            self.goes_on.wait(HANG_S)
        if self.space == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = min(size, self.space)
        self.space -= taken
        return taken

    def write(self, handle: int, content: bytes) -> int:
        return self._write(handle, content[: self._take(len(content))])

    def write_whole(self, path: Path, content: bytes) -> None:
        if self._take(len(content)) < len(content):
            raise OSError(errno.ENOSPC, "No space left on device")
        self._whole(path, content)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_run_files_are_written_in_order_after_settling(tmp_path: Path) -> None:
    warned: list[str] = []
    files = RunFiles(tmp_path, warned.append)
    for i in range(1000):
        files.append("a.log", b"%d\n" % i)
        files.append("b.log", b"%d\n" % -i)
    files.rename("a.log", "a-1.log")
    files.rename("never.log", "never-1.log")  # what nobody appended to has nothing to give
    files.append("a.log", b"new\n")
    files.write_file("whole.json", b"{}")
    files.wait_until_written()
    assert (tmp_path / "a-1.log").read_bytes() == b"".join(b"%d\n" % i for i in range(1000))
    assert (tmp_path / "a.log").read_bytes() == b"new\n"
    assert (tmp_path / "whole.json").read_bytes() == b"{}"
    assert files.close() == ""
    assert warned == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a-1.log",
        "a.log",
        "b.log",
        "whole.json",
    ]


def test_nothing_is_lost_when_a_full_disk_has_room_again(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 60.0)
    warned: list[str] = []
    files = RunFiles(tmp_path, warned.append)
    disk.space = 10
    files.append("a.log", b"0123456789abcdef")
    files.write_file("whole.json", b"{}")
    wait_until(lambda: warned, "a warning")
    assert (tmp_path / "a.log").read_bytes() == b"0123456789"
    began = time.monotonic()
    files.wait_until_written()
    assert time.monotonic() - began < 30.0  # not the whole limit: writing has failed
    disk.space = 2**30
    wait_until(lambda: (tmp_path / "whole.json").exists(), "the second file")
    assert (tmp_path / "a.log").read_bytes() == b"0123456789abcdef"
    assert files.close() == ""
    assert warned == [f"{tmp_path}: No space left on device"]


def test_run_files_on_full_disk_are_absent_and_reported(tmp_path: Path, disk: Disk) -> None:
    warned: list[str] = []
    files = RunFiles(tmp_path, warned.append)
    disk.space = 0
    for i in range(100):
        files.append("a.log", b"%d\n" % i)
    files.write_file("whole.json", b"{}")
    wait_until(lambda: warned, "a warning")
    assert files.close() == f"{tmp_path}: No space left on device"
    assert len(warned) == 1
    assert list(tmp_path.iterdir()) == []


def test_run_files_on_hanging_disk_block_nobody_within_bounded_memory(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "MAX_PENDING_BYTES", 10_000)
    files = RunFiles(tmp_path, lambda _: None)
    disk.hangs = True
    began = time.monotonic()
    for _ in range(1000):
        files.append("a.log", b"x" * 100)
    assert sum(len(task.content) for task in files._tasks) <= 10_000
    assert files.close() == f"{tmp_path}: the disk has not answered for 0.3 s"
    assert time.monotonic() - began < HANG_S / 2  # no caller waited for the disk
    disk.goes_on.set()


def test_what_comes_too_fast_for_a_slow_disk_is_told(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "MAX_PENDING_BYTES", 10_000)
    monkeypatch.setattr(under_test, "DISK_TIMEOUT_S", 5.0)
    files = RunFiles(tmp_path, lambda _: None)
    disk.hangs = True
    for i in range(200):
        files.append("a.log", b"%099d\n" % i)
    disk.hangs = False
    disk.goes_on.set()
    assert files.close() == f"{tmp_path}: the disk is too slow for the run's output"
    kept = (tmp_path / "a.log").read_bytes().splitlines()
    assert [int(line) for line in kept] == list(range(100))


def test_run_files_without_folder_are_not_kept() -> None:
    files = RunFiles(None, pytest.fail)
    files.append("a.log", b"x")
    files.write_file("whole.json", b"{}")
    files.wait_until_written()
    assert files.close() == ""


def test_run_log_that_floods_is_cut_and_marked(
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

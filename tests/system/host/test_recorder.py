"""The record of a host reaches the disk within a second, survives a full disk, and never delays a tick."""

import errno
import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from threading import Event

import msgspec
import pytest

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.programs.host_program import create_host_record
from snakesim_hal.run_log import writer as writer_module
from snakesim_hal.run_log.black_box import BlackBox, compute_digest, read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD, HostRecord
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_testing.hal.local_network import SineFollower, running_follower, running_host
from snakesim_testing.hal.small_robots import make_description, make_joint_state, make_run_config
from snakesim_testing.harness.wait import wait_until

ROBOT = make_description()
TICK_OUTPUT = TickOutput(SafeSetpoints([JointMode.POSITION] * 3, [0.1] * 3, [4.0] * 3), 1, {})
ROW_BYTES = BlackBox(ROBOT).layout.row_bytes
UNLIMITED_BYTES = 2**30
MAX_RECORD_BYTES = 2**20


class RecordNumbers(msgspec.Struct):
    """The numbers of a host record that these tests compare."""

    ticks: int
    lost_ticks: int
    failure: str


def record_ticks(box: BlackBox, *ticks: int) -> None:
    """Record a row for each tick in the black box."""
    for tick in ticks:
        box.record_tick(
            tick, tick * 10_000_000, Samples(make_joint_state(ROBOT, 0.001 * tick)), TICK_OUTPUT
        )


def make_writer(box: BlackBox, folder: Path | None, memory: int | None = None) -> HostRecordWriter:
    """Create a writer of the host record.

    Args:
        box: The black box whose rows it writes.
        folder: Folder of the record; None for a run without a folder.
        memory: Handle of the shared memory that receives the numbers, too.
    """

    def make_numbers(*, lost_ticks: int, failure: str) -> RecordNumbers:
        return RecordNumbers(box.row_count, lost_ticks, failure)

    return HostRecordWriter(box, ROBOT, make_numbers, folder, memory)


def read_numbers_on_disk(folder: Path) -> RecordNumbers:
    return msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=RecordNumbers)


def read_ticks_on_disk(folder: Path) -> list[int]:
    """Return the ticks of the rows on disk, or an empty list if there is no file yet."""
    path = folder / BLACK_BOX
    if not path.exists():
        return []
    _, columns = read_black_box(path)
    return columns["tick"].tolist()


@pytest.fixture
def memory() -> Iterator[int]:
    """Open a memory file like the one that the supervisor shares with the host."""
    handle = os.memfd_create("test")
    yield handle
    for thread in [thread for thread in threading.enumerate() if thread.name == "recorder"]:
        # A suspended thread would write into the next file that gets this handle.
        thread.join(5.0)
    os.close(handle)


def read_numbers_in_memory(memory: int) -> RecordNumbers:
    return msgspec.json.decode(os.pread(memory, MAX_RECORD_BYTES, 0), type=RecordNumbers)


def test_recorder_writes_rows_within_a_second_and_all_at_end(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    with make_writer(box, tmp_path, memory):
        record_ticks(box, *range(40))
        assert writer_module.WRITE_PERIOD_S < 1.0
        wait_until(lambda: read_ticks_on_disk(tmp_path) == list(range(40)), "the rows", 30.0)
        wait_until(
            lambda: (
                (tmp_path / HOST_RECORD).exists() and read_numbers_on_disk(tmp_path).ticks == 40
            ),
            "the numbers",
            30.0,
        )
        record_ticks(box, *range(40, 45))
    assert read_ticks_on_disk(tmp_path) == list(range(45))
    assert (
        read_numbers_on_disk(tmp_path) == read_numbers_in_memory(memory) == RecordNumbers(45, 0, "")
    )
    assert compute_digest(read_black_box(tmp_path / BLACK_BOX)[1]) == box.command_digest
    assert (
        msgspec.json.decode((tmp_path / DESCRIPTION).read_bytes(), type=RobotDescription) == ROBOT
    )
    assert {path.name for path in tmp_path.iterdir()} == {BLACK_BOX, HOST_RECORD, DESCRIPTION}


def test_recorder_of_restarted_host_keeps_earlier_record(tmp_path: Path) -> None:
    for first_tick in (0, 100, 200):
        box = BlackBox(ROBOT)
        with make_writer(box, tmp_path):
            record_ticks(box, first_tick)
    assert read_ticks_on_disk(tmp_path) == [200]
    for number in (1, 2):
        _, columns = read_black_box(tmp_path / f"blackbox-{number}.rows")
        assert columns["tick"].tolist() == [100 * (number - 1)]
        assert (tmp_path / f"host-{number}.json").is_file()


class Disk:
    """A disk that accepts `free_bytes` of each file, and is then full or hangs.

    Writes to the memory file are not limited.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, memory: int) -> None:
        self.free_bytes = UNLIMITED_BYTES
        self.hangs_when_full = False
        self.should_continue = Event()
        self.is_hanging = Event()
        self._memory = memory
        self._pwrite = os.pwrite
        monkeypatch.setattr(writer_module.os, "pwrite", self.pwrite)
        monkeypatch.setattr(writer_module, "WRITE_PERIOD_S", 0.02)

    def pwrite(self, handle: int, content: bytes, offset: int) -> int:
        if handle == self._memory:
            return self._pwrite(handle, content, offset)
        free_bytes = max(self.free_bytes - offset, 0)
        if free_bytes == 0 and content:
            if self.hangs_when_full:
                self.is_hanging.set()
                self.should_continue.wait(30)
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._pwrite(handle, content[:free_bytes], offset)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch, memory: int) -> Disk:
    return Disk(monkeypatch, memory)


def test_recorder_writes_what_full_disk_refused_when_space_returns(
    tmp_path: Path, memory: int, disk: Disk, capfd: pytest.CaptureFixture[str]
) -> None:
    box = BlackBox(ROBOT)
    # The disk has room for seven rows and a part of the eighth.
    disk.free_bytes = len(box.layout.encode_header()) + 7 * ROW_BYTES + 11
    with make_writer(box, tmp_path, memory):
        record_ticks(box, *range(20))
        wait_until(
            lambda: len(os.pread(memory, 9, 0)) and read_numbers_in_memory(memory).failure,
            "the failure in the record",
        )
        assert read_ticks_on_disk(tmp_path) == list(range(7))
        assert read_numbers_in_memory(memory).lost_ticks == 0
        disk.free_bytes = UNLIMITED_BYTES
        wait_until(lambda: not read_numbers_in_memory(memory).failure, "free space")
    assert read_ticks_on_disk(tmp_path) == list(range(20))
    assert (
        read_numbers_on_disk(tmp_path) == read_numbers_in_memory(memory) == RecordNumbers(20, 0, "")
    )
    assert (
        capfd.readouterr().err == f"record: {tmp_path}: No space left on device\n"
    )  # printed once


def test_recorder_counts_unwritten_rows_and_gaps_show_in_ticks(
    tmp_path: Path, memory: int, disk: Disk
) -> None:
    box = BlackBox(ROBOT, memory_bytes=10 * ROW_BYTES)
    header_bytes = len(box.layout.encode_header())
    disk.free_bytes = header_bytes + 3 * ROW_BYTES
    with make_writer(box, tmp_path, memory):
        record_ticks(box, *range(5))
        wait_until(lambda: read_ticks_on_disk(tmp_path) == [0, 1, 2], "the first rows")
        record_ticks(box, *range(5, 30))
        disk.free_bytes = header_bytes + 8 * ROW_BYTES
        wait_until(lambda: len(read_ticks_on_disk(tmp_path)) == 8, "some of the newest")
    assert read_ticks_on_disk(tmp_path) == [0, 1, 2, 21, 22, 23, 24, 25]
    last = read_numbers_in_memory(memory)
    assert last.lost_ticks == 18 + 4
    assert last.failure == f"{tmp_path}: No space left on device"


def test_recorder_in_unwritable_folder_leaves_no_empty_file(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    with make_writer(box, tmp_path / "gone", memory):
        record_ticks(box, 1, 2)
    assert not (tmp_path / "gone").exists()
    last = read_numbers_in_memory(memory)
    assert last.lost_ticks == 2
    assert "No such file" in last.failure


def test_recorder_with_hanging_disk_delays_no_tick_and_no_end(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "CLOSE_TIMEOUT_S", 0.3)
    with (
        running_host(make_run_config(clock_mode="lockstep"), max_ticks=75) as run,
        running_follower(run.link, SineFollower()),
    ):
        with HostRecordWriter(
            run.host.black_box,
            run.host.description,
            partial(create_host_record, run.host),
            tmp_path,
            memory,
        ):
            layout = run.host.black_box.layout
            disk.free_bytes = len(layout.encode_header()) + 6 * layout.row_bytes
            disk.hangs_when_full = True
            run.arm()
            wait_until(run.has_ended, "the end of the run")
            assert disk.is_hanging.wait(5.0)
        # Neither the run nor the end of its recorder waited for the disk.
        assert not disk.should_continue.is_set()
        assert run.host.ending_status == "complete"
        assert not run.host.authority.faults
    last = msgspec.json.decode(os.pread(memory, MAX_RECORD_BYTES, 0), type=HostRecord)
    assert last.ended == "complete"
    assert last.armed_ticks == 75
    assert 0 < last.lost_ticks < 75
    assert "has not answered" in last.failure
    disk.should_continue.set()


def test_recorder_without_folder_writes_numbers_into_memory(memory: int) -> None:
    box = BlackBox(ROBOT)
    with make_writer(box, None, memory):
        record_ticks(box, 1, 2, 3)
    assert read_numbers_in_memory(memory) == RecordNumbers(3, 3, "")


def test_recorder_with_too_slow_disk_still_writes_numbers(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = BlackBox(ROBOT)
    write_to_disk = disk.pwrite

    def write_while_host_continues(handle: int, content: bytes, offset: int) -> int:
        if handle != memory:
            record_ticks(box, box.row_count)  # The host adds a row during each write.
        return write_to_disk(handle, content, offset)

    monkeypatch.setattr(writer_module.os, "pwrite", write_while_host_continues)
    with make_writer(box, tmp_path, memory):
        record_ticks(box, 0)
        wait_until(
            lambda: (tmp_path / HOST_RECORD).exists() and read_numbers_on_disk(tmp_path).ticks > 3,
            "numbers",
            5.0,
        )

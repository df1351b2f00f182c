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
SLOW_DISK_LIMIT_S = 30.0  # for a busy computer; the recorder itself writes within a second


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


def read_ticks(path: Path) -> list[int]:
    """Return the ticks of the rows in the file of a black box."""
    _, columns = read_black_box(path)
    return columns["tick"].tolist()


def read_ticks_on_disk(folder: Path) -> list[int]:
    """Return the ticks of the rows on disk, or an empty list if there is no file yet."""
    path = folder / BLACK_BOX
    return read_ticks(path) if path.exists() else []


@pytest.fixture
def memory() -> Iterator[int]:
    """Open a memory file like the one that the supervisor shares with the host."""
    handle = os.memfd_create("test")
    yield handle
    for thread in [thread for thread in threading.enumerate() if thread.name == "recorder"]:
        # A suspended thread would write into the next file that gets this handle.
        thread.join(5.0)
    os.close(handle)


def has_numbers(memory: int) -> bool:
    """Return whether the recorder has written into the memory file."""
    return len(os.pread(memory, 1, 0)) > 0


def read_numbers_in_memory(memory: int) -> RecordNumbers:
    return msgspec.json.decode(os.pread(memory, MAX_RECORD_BYTES, 0), type=RecordNumbers)


def test_recorder_writes_rows_within_a_second_and_all_at_end(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    early_ticks = range(40)  # written while the host runs
    last_ticks = range(40, 45)  # recorded just before the end of the host
    tick_count = len(early_ticks) + len(last_ticks)

    def are_early_numbers_on_disk() -> bool:
        if not (tmp_path / HOST_RECORD).exists():
            return False
        return read_numbers_on_disk(tmp_path).ticks == len(early_ticks)

    assert writer_module.WRITE_PERIOD_S < 1.0, "a crash would lose more than the rows of a second"
    with make_writer(box, tmp_path, memory):
        record_ticks(box, *early_ticks)
        wait_until(
            lambda: read_ticks_on_disk(tmp_path) == list(early_ticks), "the rows", SLOW_DISK_LIMIT_S
        )
        wait_until(are_early_numbers_on_disk, "the numbers", SLOW_DISK_LIMIT_S)
        record_ticks(box, *last_ticks)

    assert read_ticks_on_disk(tmp_path) == list(range(tick_count))
    assert (
        read_numbers_on_disk(tmp_path)
        == read_numbers_in_memory(memory)
        == RecordNumbers(tick_count, lost_ticks=0, failure="")
    )
    assert compute_digest(read_black_box(tmp_path / BLACK_BOX)[1]) == box.command_digest
    assert (
        msgspec.json.decode((tmp_path / DESCRIPTION).read_bytes(), type=RobotDescription) == ROBOT
    )
    assert {path.name for path in tmp_path.iterdir()} == {BLACK_BOX, HOST_RECORD, DESCRIPTION}, (
        "the recorder leaves no temporary file"
    )


def test_recorder_of_restarted_host_keeps_earlier_record(tmp_path: Path) -> None:
    """A restarted host moves the record of each earlier start into files with a number, in order of the starts."""
    # Each start of the host records one row. Its tick shows to which start a file belongs.
    first_start_tick = 0
    second_start_tick = 100
    newest_start_tick = 200

    for tick in (first_start_tick, second_start_tick, newest_start_tick):
        box = BlackBox(ROBOT)
        with make_writer(box, tmp_path):
            record_ticks(box, tick)

    assert read_ticks(tmp_path / "blackbox-1.rows") == [first_start_tick]
    assert read_ticks(tmp_path / "blackbox-2.rows") == [second_start_tick]
    assert read_ticks_on_disk(tmp_path) == [newest_start_tick], (
        "the newest start has the file name without a number"
    )
    for filename in ("host-1.json", "host-2.json"):
        assert (tmp_path / filename).is_file(), f"the numbers of an earlier start: {filename}"


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
    tick_count = 20
    rows_with_space = 7
    part_of_a_row_bytes = 11
    assert part_of_a_row_bytes < ROW_BYTES
    header_bytes = len(box.layout.encode_header())
    disk.free_bytes = header_bytes + rows_with_space * ROW_BYTES + part_of_a_row_bytes

    with make_writer(box, tmp_path, memory):
        record_ticks(box, *range(tick_count))
        wait_until(
            lambda: has_numbers(memory) and read_numbers_in_memory(memory).failure,
            "the failure in the record",
        )
        assert read_ticks_on_disk(tmp_path) == list(range(rows_with_space))
        assert read_numbers_in_memory(memory).lost_ticks == 0, "the other rows are still in memory"
        disk.free_bytes = UNLIMITED_BYTES
        wait_until(lambda: not read_numbers_in_memory(memory).failure, "free space")

    assert read_ticks_on_disk(tmp_path) == list(range(tick_count))
    assert (
        read_numbers_on_disk(tmp_path)
        == read_numbers_in_memory(memory)
        == RecordNumbers(tick_count, lost_ticks=0, failure="")
    )
    assert capfd.readouterr().err == f"record: {tmp_path}: No space left on device\n", (
        "the failure is printed once, not for each attempt to write"
    )


def test_recorder_counts_unwritten_rows_and_gaps_show_in_ticks(
    tmp_path: Path, memory: int, disk: Disk
) -> None:
    """The disk is full after 3 rows. Of 30 rows, memory then keeps the newest, and 5 of them fit onto the disk."""
    # Of ten rows in memory, nine are read, because the host may overwrite the oldest at this moment.
    box = BlackBox(ROBOT, memory_bytes=10 * ROW_BYTES)
    header_bytes = len(box.layout.encode_header())
    disk.free_bytes = header_bytes + 3 * ROW_BYTES

    with make_writer(box, tmp_path, memory):
        record_ticks(box, *range(5))
        wait_until(lambda: read_ticks_on_disk(tmp_path) == [0, 1, 2], "the first rows")
        record_ticks(box, *range(5, 30))
        disk.free_bytes = header_bytes + 8 * ROW_BYTES
        wait_until(lambda: len(read_ticks_on_disk(tmp_path)) == 8, "some of the newest")

    assert read_ticks_on_disk(tmp_path) == [0, 1, 2, 21, 22, 23, 24, 25], (
        "a reader sees the gap in the ticks"
    )
    last = read_numbers_in_memory(memory)
    overwritten_in_memory = 18  # ticks 3 to 20
    still_in_memory_at_end = 4  # ticks 26 to 29
    assert last.lost_ticks == overwritten_in_memory + still_in_memory_at_end
    assert last.failure == f"{tmp_path}: No space left on device"


def test_recorder_in_unwritable_folder_leaves_no_empty_file(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    missing_folder = tmp_path / "gone"

    with make_writer(box, missing_folder, memory):
        record_ticks(box, 1, 2)

    assert not missing_folder.exists()
    last = read_numbers_in_memory(memory)
    assert last.lost_ticks == 2
    assert "No such file" in last.failure


def test_recorder_with_hanging_disk_delays_no_tick_and_no_end(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "CLOSE_TIMEOUT_S", 0.3)  # does not wait long for the disk
    tick_count = 75
    rows_until_disk_hangs = 6
    with (
        running_host(make_run_config(clock_mode="lockstep"), max_ticks=tick_count) as run,
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
            header_bytes = len(layout.encode_header())
            disk.free_bytes = header_bytes + rows_until_disk_hangs * layout.row_bytes
            disk.hangs_when_full = True

            run.arm()
            wait_until(run.has_ended, "the end of the run")
            assert disk.is_hanging.wait(5.0), "the recorder has filled the disk"

        assert not disk.should_continue.is_set(), (
            "the run and the end of its recorder must not wait for the disk"
        )
        assert run.host.ending_status == "complete"
        assert not run.host.authority.faults

    last = msgspec.json.decode(os.pread(memory, MAX_RECORD_BYTES, 0), type=HostRecord)
    assert last.ended == "complete"
    assert last.armed_ticks == tick_count
    assert 0 < last.lost_ticks < tick_count
    assert "has not answered" in last.failure
    disk.should_continue.set()


def test_recorder_without_folder_writes_numbers_into_memory(memory: int) -> None:
    box = BlackBox(ROBOT)

    with make_writer(box, None, memory):
        record_ticks(box, 1, 2, 3)

    assert read_numbers_in_memory(memory) == RecordNumbers(3, lost_ticks=3, failure=""), (
        "without a folder no row is stored, which is no failure"
    )


def test_recorder_with_too_slow_disk_still_writes_numbers(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = BlackBox(ROBOT)
    write_to_disk = disk.pwrite

    def write_while_host_continues(handle: int, content: bytes, offset: int) -> int:
        if handle != memory:
            record_ticks(box, box.row_count)  # The host adds a row during each write.
        return write_to_disk(handle, content, offset)

    def are_numbers_of_later_rows_on_disk() -> bool:
        if not (tmp_path / HOST_RECORD).exists():
            return False
        return read_numbers_on_disk(tmp_path).ticks > 3

    monkeypatch.setattr(writer_module.os, "pwrite", write_while_host_continues)
    with make_writer(box, tmp_path, memory):
        record_ticks(box, 0)
        wait_until(are_numbers_of_later_rows_on_disk, "numbers, although rows are left", 5.0)

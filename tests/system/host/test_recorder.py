"""What a host leaves on disk: there within a second, whole when the disk comes back, and never waited for."""

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
from snakesim_hal.run_log import writer as under_test
from snakesim_hal.run_log.black_box import BlackBox, compute_digest, read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD, HostRecord
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_testing.hal.local_network import SineFollower, running_follower, running_host
from snakesim_testing.hal.small_robots import make_description, make_joint_state, make_run_config
from snakesim_testing.harness.wait import wait_until

ROBOT = make_description()
TOLD = TickOutput(SafeSetpoints([JointMode.POSITION] * 3, [0.1] * 3, [4.0] * 3), 1, {})
ROW = BlackBox(ROBOT).layout.row_bytes


class Numbers(msgspec.Struct):
    ticks: int
    lost_ticks: int
    failure: str


def fill(box: BlackBox, *ticks: int) -> None:
    for tick in ticks:
        box.record_tick(
            tick, tick * 10_000_000, Samples(make_joint_state(ROBOT, 0.001 * tick)), TOLD
        )


def recorder(box: BlackBox, folder: Path | None, memory: int | None = None) -> HostRecordWriter:
    def numbers(*, lost_ticks: int, failure: str) -> Numbers:
        return Numbers(box.row_count, lost_ticks, failure)

    return HostRecordWriter(box, ROBOT, numbers, folder, memory)


def reported(folder: Path) -> Numbers:
    return msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=Numbers)


def ticks_on_disk(folder: Path) -> list[int]:
    return (
        read_black_box(folder / BLACK_BOX)[1]["tick"].tolist()
        if (folder / BLACK_BOX).exists()
        else []
    )


@pytest.fixture
def memory() -> Iterator[int]:
    handle = os.memfd_create("test")
    yield handle
    for thread in [thread for thread in threading.enumerate() if thread.name == "recorder"]:
        thread.join(5.0)  # one that suspended would write to whatever has this number next
    os.close(handle)


def remembered(memory: int) -> Numbers:
    return msgspec.json.decode(os.pread(memory, 2**20, 0), type=Numbers)


def test_recorder_writes_rows_within_a_second_and_all_at_end(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    with recorder(box, tmp_path, memory):
        fill(box, *range(40))
        assert under_test.WRITE_PERIOD_S < 1.0
        wait_until(lambda: ticks_on_disk(tmp_path) == list(range(40)), "the rows", 30.0)
        wait_until(
            lambda: (tmp_path / HOST_RECORD).exists() and reported(tmp_path).ticks == 40,
            "the numbers",
            30.0,
        )
        fill(box, *range(40, 45))
    assert ticks_on_disk(tmp_path) == list(range(45))
    assert reported(tmp_path) == remembered(memory) == Numbers(45, 0, "")
    assert compute_digest(read_black_box(tmp_path / BLACK_BOX)[1]) == box.command_digest
    assert (
        msgspec.json.decode((tmp_path / DESCRIPTION).read_bytes(), type=RobotDescription) == ROBOT
    )
    assert {path.name for path in tmp_path.iterdir()} == {BLACK_BOX, HOST_RECORD, DESCRIPTION}


def test_recorder_of_restarted_host_keeps_the_earlier_record(tmp_path: Path) -> None:
    for first in (0, 100, 200):
        box = BlackBox(ROBOT)
        with recorder(box, tmp_path):
            fill(box, first)
    assert ticks_on_disk(tmp_path) == [200]
    for number in (1, 2):
        _, columns = read_black_box(tmp_path / f"blackbox-{number}.rows")
        assert columns["tick"].tolist() == [100 * (number - 1)]
        assert (tmp_path / f"host-{number}.json").is_file()


class Disk:
    """A disk that takes `space` bytes of rows, and is then full, or hangs; everything else goes its way."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, memory: int) -> None:
        self.space, self.hangs, self.should_continue = 2**30, False, Event()
        self.is_hanging = Event()
        self._memory, self._pwrite = memory, os.pwrite
        monkeypatch.setattr(under_test.os, "pwrite", self.pwrite)
        monkeypatch.setattr(under_test, "WRITE_PERIOD_S", 0.02)

    def pwrite(self, handle: int, content: bytes, offset: int) -> int:
        if handle == self._memory:
            return self._pwrite(handle, content, offset)
        room = max(self.space - offset, 0)
        if room == 0 and content:
            if self.hangs:
                self.is_hanging.set()
                self.should_continue.wait(30)
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._pwrite(handle, content[:room], offset)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch, memory: int) -> Disk:
    return Disk(monkeypatch, memory)


def test_recorder_writes_what_full_disk_refused_when_space_returns(
    tmp_path: Path, memory: int, disk: Disk, capfd: pytest.CaptureFixture[str]
) -> None:
    box = BlackBox(ROBOT)
    disk.space = len(box.layout.encode_header()) + 7 * ROW + 11  # the eighth row is torn
    with recorder(box, tmp_path, memory):
        fill(box, *range(20))
        wait_until(
            lambda: len(os.pread(memory, 9, 0)) and remembered(memory).failure, "a word about it"
        )
        assert ticks_on_disk(tmp_path) == list(range(7))
        assert remembered(memory).lost_ticks == 0
        disk.space = 2**30
        wait_until(lambda: not remembered(memory).failure, "room")
    assert ticks_on_disk(tmp_path) == list(range(20))
    assert reported(tmp_path) == remembered(memory) == Numbers(20, 0, "")
    assert capfd.readouterr().err == f"record: {tmp_path}: No space left on device\n"  # once


def test_recorder_counts_unwritten_rows_and_gaps_show_in_ticks(
    tmp_path: Path, memory: int, disk: Disk
) -> None:
    box = BlackBox(ROBOT, memory_bytes=10 * ROW)
    begins = len(box.layout.encode_header())
    disk.space = begins + 3 * ROW
    with recorder(box, tmp_path, memory):
        fill(box, *range(5))
        wait_until(lambda: ticks_on_disk(tmp_path) == [0, 1, 2], "the first rows")
        fill(box, *range(5, 30))
        disk.space = begins + 8 * ROW
        wait_until(lambda: len(ticks_on_disk(tmp_path)) == 8, "some of the newest")
    assert ticks_on_disk(tmp_path) == [0, 1, 2, 21, 22, 23, 24, 25]
    last = remembered(memory)
    assert last.lost_ticks == 18 + 4
    assert last.failure == f"{tmp_path}: No space left on device"


def test_recorder_in_unwritable_folder_leaves_no_empty_file(tmp_path: Path, memory: int) -> None:
    box = BlackBox(ROBOT)
    with recorder(box, tmp_path / "gone", memory):
        fill(box, 1, 2)
    assert not (tmp_path / "gone").exists()
    last = remembered(memory)
    assert last.lost_ticks == 2
    assert "No such file" in last.failure


def test_recorder_with_hanging_disk_delays_no_tick_and_no_end(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "CLOSE_TIMEOUT_S", 0.3)
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
            disk.space, disk.hangs = len(layout.encode_header()) + 6 * layout.row_bytes, True
            run.arm()
            wait_until(run.has_ended, "the end of the run")
            assert disk.is_hanging.wait(5.0)
        # Neither the run nor its recorder's end waited for it.
        assert not disk.should_continue.is_set()
        assert run.host.ending_status == "complete"
        assert not run.host.authority.faults
    last = msgspec.json.decode(os.pread(memory, 2**20, 0), type=HostRecord)
    assert last.ended == "complete"
    assert last.armed_ticks == 75
    assert 0 < last.lost_ticks < 75
    assert "has not answered" in last.failure
    disk.should_continue.set()


def test_without_a_folder_only_the_memory_knows(memory: int) -> None:
    box = BlackBox(ROBOT)
    with recorder(box, None, memory):
        fill(box, 1, 2, 3)
    assert remembered(memory) == Numbers(3, 3, "")


def test_numbers_are_written_although_the_disk_never_catches_up(
    tmp_path: Path, memory: int, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = BlackBox(ROBOT)
    taken = disk.pwrite

    def slow(handle: int, content: bytes, offset: int) -> int:
        if handle != memory:
            fill(box, box.row_count)  # the host goes on meanwhile
        return taken(handle, content, offset)

    monkeypatch.setattr(under_test.os, "pwrite", slow)
    with recorder(box, tmp_path, memory):
        fill(box, 0)
        wait_until(
            lambda: (tmp_path / HOST_RECORD).exists() and reported(tmp_path).ticks > 3,
            "numbers",
            5.0,
        )

"""A bus between programs without CAN in the kernel: who gets which frames, and what one program does to others."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_can_backend.bus.adapter import (
    is_emulated,
    open_wire,
    validate_channel,
    validate_channels,
)
from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.local_wire import INBOX_BYTES, MAGIC, RECORD_FORMAT, LocalWire
from snakesim_can_backend.bus.unknown_frames import LocalBusReader, listen_for_unknown_frames
from snakesim_can_backend.protocol.definitions import CanFrame, Opcode, frame_id
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_testing.messages import raises_error

FRAME = CanFrame(0x123, b"\1\2\3")
FLOOD_FRAMES = 3 * INBOX_BYTES // RECORD_FORMAT.size
# Joins the bus and sends a frame. At each line of its input it prints the ids that it has received, and its errors.
MEMBER = """
import json, sys
from snakesim_can_backend.bus.local_wire import LocalWire
from snakesim_can_backend.protocol.definitions import CanFrame
wire = LocalWire(sys.argv[1])
wire.send(CanFrame(0x123, b"\\1\\2\\3"))
print("joined", flush=True)
for line in sys.stdin:
    ids = []
    while frames := wire.receive():
        ids += [frame.id for frame in frames]
    print(json.dumps([ids, [[error.kind, error.detail] for error in wire.errors()]]), flush=True)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "bus"


@contextlib.contextmanager
def join(folder: Path, count: int) -> Iterator[list[LocalWire]]:
    """Several ends of one bus in this process, for CAN FD."""
    with contextlib.ExitStack() as opened:
        yield [
            opened.enter_context(contextlib.closing(LocalWire(str(folder), fd=True)))
            for _ in range(count)
        ]


@contextlib.contextmanager
def run_member(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process on the bus."""
    process = subprocess.Popen(
        [sys.executable, "-c", MEMBER, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "joined\n"
        try:
            yield process
        finally:
            process.kill()


def report(process: subprocess.Popen[str]) -> tuple[list[int], list[list[str]]]:
    """The ids that another process has received since the last report, and its bus errors: kind and detail."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    ids, errors = json.loads(process.stdout.readline())
    return ids, errors


def list_kinds(wire: LocalWire) -> list[str]:
    return [error.kind for error in wire.errors()]


def test_frames_reach_every_other_end_in_order(folder: Path) -> None:
    frames = [CanFrame(0x8001, bytes(range(64))), CanFrame(0x101, b"")]
    with join(folder, 3) as (first, *others):
        for frame in frames:
            assert first.send(frame)
        for wire in others:
            assert wait([wire], 1.0)
            assert wire.receive() == frames
            assert wire.receive() == []
        assert first.receive() == []
    assert not folder.exists(), "the last program removes the folder"


def test_several_writers_reach_one_reader(folder: Path) -> None:
    with join(folder, 4) as (reader, *writers):
        for i in range(100):
            for identifier, wire in enumerate(writers):
                wire.send(CanFrame(identifier, bytes([i])))
        frames = reader.receive()
    for identifier in range(3):
        assert [frame.data[0] for frame in frames if frame.id == identifier] == [*range(100)]


def test_a_program_that_joins_late_gets_every_later_frame(folder: Path) -> None:
    with join(folder, 1) as (first,):
        for _ in range(200):
            first.send(CanFrame(1, b"too early"))
            with join(folder, 1) as (late,):
                first.send(FRAME)
                assert late.receive() == [FRAME]


def test_one_end_of_classic_can_ignores_what_it_cannot_receive(folder: Path) -> None:
    with (
        join(folder, 1) as (sender,),
        contextlib.closing(open_wire(f"local:{folder}")) as classic,
        contextlib.closing(open_wire(f"local:{folder}", [Opcode.SYNC])) as filtered,
    ):
        sync = CanFrame(frame_id(Opcode.SYNC, 0), bytes(6))
        for frame in (CanFrame(0x800, b""), CanFrame(1, bytes(12)), FRAME, sync):
            sender.send(frame)
        assert classic.receive() == [FRAME, sync]
        assert filtered.receive() == [sync]
        with pytest.raises(BackendError, match="65 bytes, at most 64"):
            sender.send(CanFrame(1, bytes(65)))


def test_a_frozen_reader_delays_no_other_and_its_lost_frames_are_reported(folder: Path) -> None:
    with join(folder, 2) as (writer, reader), run_member(folder) as frozen:
        reader.receive()
        writer.receive()
        os.kill(frozen.pid, signal.SIGSTOP)
        received: list[CanFrame] = []
        for i in range(FLOOD_FRAMES):
            assert writer.send(CanFrame(i % 0x800, b""))
            if i % 500 == 499:
                received += reader.receive()
        received += reader.receive()
        sent_ids = [i % 0x800 for i in range(FLOOD_FRAMES)]
        assert [frame.id for frame in received] == sent_ids, "another reader gets everything"
        assert list_kinds(reader) == []
        (at_writer,) = writer.errors()
        assert at_writer.kind == "queue_full"
        assert writer.errors() == [], "each lost frame is reported once"

        # The frozen program continues: it gets the frames that fitted, whole and in order. The next frame brings the
        # number of the lost ones.
        os.kill(frozen.pid, signal.SIGCONT)
        ids, errors = report(frozen)
        lost = FLOOD_FRAMES - len(ids)
        assert ids == sent_ids[: len(ids)]
        assert lost > 0
        assert at_writer.detail.startswith(f"{lost} frames")
        assert errors == []
        writer.send(FRAME)
        ids, ((kind, detail),) = report(frozen)
        assert ids == [FRAME.id]
        assert kind == "receive_overflow"
        assert detail.startswith(f"{lost} frames")


def test_a_killed_program_is_forgotten_and_another_takes_its_place(folder: Path) -> None:
    with join(folder, 1) as (wire,):
        assert list_kinds(wire) == [], "a program may be the first on the bus"
        for _ in range(2):
            with run_member(folder) as process:
                wait([wire], 1.0)
                assert wire.receive() == [FRAME]
                assert "interface_down" not in list_kinds(wire)
                process.send_signal(signal.SIGKILL)
                process.wait(10)
                assert len([*folder.iterdir()]) == 2, "it could not clean up"
            assert wire.send(FRAME)
            assert [*folder.iterdir()] == [wire._inbox_path]
            assert list_kinds(wire) == ["interface_down"]
            assert list_kinds(wire) == []
        with join(folder, 1):
            assert list_kinds(wire) == ["interface_up"]


def test_the_next_program_removes_what_killed_ones_left(folder: Path) -> None:
    with run_member(folder) as process:
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert len([*folder.iterdir()]) == 1
    with raises_error(ConfigError, code="bus/not-available", field="no program is on this bus"):
        validate_channel(f"local:{folder}")
    LocalWire(str(folder)).close()
    assert not folder.exists()


def test_the_last_program_removes_the_bus_with_what_killed_ones_left(folder: Path) -> None:
    with join(folder, 1) as (wire,), run_member(folder) as process:
        wire.send(FRAME)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert not folder.exists()


def test_bytes_that_are_no_frames_are_skipped(folder: Path) -> None:
    record = RECORD_FORMAT.pack(MAGIC, 0, FRAME.id, len(FRAME.data), FRAME.data)
    too_long = RECORD_FORMAT.pack(MAGIC, 0, 1, 65, b"")
    with join(folder, 1) as (wire,):
        with wire._inbox_path.open("wb", buffering=0) as inbox:
            inbox.write(os.urandom(33).replace(MAGIC, b"") + record + too_long + record[:50])
        assert wire.receive() == [FRAME]
        with wire._inbox_path.open("wb", buffering=0) as inbox:
            inbox.write(record)
        assert wire.receive() == [FRAME]


def test_frames_of_others_are_listed(folder: Path) -> None:
    """As `snakesim drive scan can` does before it sends anything."""
    with join(folder, 2) as (other, listener):
        heartbeat = CanFrame(0x701, b"\5")
        for frame in (
            heartbeat,
            CanFrame(0x12345, bytes(8)),
            CanFrame(0x101, bytes(12)),
            heartbeat,
        ):
            other.send(frame)
        unknown = listen_for_unknown_frames(LocalBusReader(listener), 0.05)
    assert [(frames.id, frames.frames, frames.origin) for frames in unknown] == [
        (0x101, 1, "CAN FD"),
        (0x701, 2, "as CANopen's heartbeat of node 1, operational"),
        (0x12345, 1, "29-bit id"),
    ]


def test_cut_end_neither_sends_nor_receives_until_the_end_of_the_fault(folder: Path) -> None:
    with join(folder, 2) as (near, far):
        near.inject("cut", begins=True)
        assert not near.send(CanFrame(1, b""))
        far.send(CanFrame(2, b""))
        wait([near], 0.2)
        assert near.receive() == []
        assert list_kinds(near) == ["interface_down"]
        near.inject("cut", begins=False)
        near.send(CanFrame(3, b""))
        wait([far], 1.0)
        assert far.receive() == [CanFrame(3, b"")]


def test_only_this_user_can_join(folder: Path) -> None:
    with join(folder, 1) as (wire,):
        assert folder.stat().st_mode & 0o777 == 0o700
        assert wire._inbox_path.stat().st_mode & 0o777 == 0o600
    folder.mkdir()
    for mode in (0o755, 0o710, 0o702):
        folder.chmod(mode)
        with raises_error(ConfigError, code="bus/invalid-channel", stored=False):
            LocalWire(str(folder))
    with raises_error(ConfigError, code="bus/invalid-channel", field="other users"):
        validate_channel(f"local:{folder}")


def test_files_of_others_in_the_folder_are_left_alone(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    log = folder / "log.can"
    log.write_text("a log")
    with join(folder, 2) as (first, second):
        first.send(FRAME)
        assert second.receive() == [FRAME]
    assert log.read_text() == "a log"
    assert [*folder.iterdir()] == [log]


def test_a_bus_without_a_program_is_refused_with_a_way_out(folder: Path, tmp_path: Path) -> None:
    channel = f"local:{folder}"
    assert is_emulated(channel)
    validate_channels([channel], is_emulator=True)
    with raises_error(ConfigError, code="bus/not-available", field="snakesim drive emulate"):
        validate_channels([channel])
    with raises_error(ConfigError, code="bus/invalid-channel", field="local"):
        validate_channel("locale:x")
    with join(folder, 1):
        validate_channels([channel], needs_fd=True)
    blocked = tmp_path / "file"
    blocked.touch()
    with pytest.raises(BackendError, match="cannot be opened"):
        LocalWire(str(blocked / "bus"))

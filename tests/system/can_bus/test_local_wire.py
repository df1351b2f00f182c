"""A local bus connects programs without CAN in the kernel, and a frozen or killed program disturbs no other one."""

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
MEMBER_CODE = """
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
    """Provide the path of a bus that does not exist yet."""
    return tmp_path / "bus"


@contextlib.contextmanager
def join(folder: Path, count: int) -> Iterator[list[LocalWire]]:
    """Open several ends of one bus in this process, for CAN FD."""
    with contextlib.ExitStack() as opened:
        yield [
            opened.enter_context(contextlib.closing(LocalWire(str(folder), fd=True)))
            for _ in range(count)
        ]


@contextlib.contextmanager
def run_member(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Run another process that joins the bus."""
    process = subprocess.Popen(
        [sys.executable, "-c", MEMBER_CODE, str(folder)],
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


def request_report(process: subprocess.Popen[str]) -> tuple[list[int], list[list[str]]]:
    """Return the ids that a process has received since its last report, and its errors as kind and detail."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    ids, errors = json.loads(process.stdout.readline())
    return ids, errors


def list_error_kinds(wire: LocalWire) -> list[str]:
    """Return the kinds of the errors since the last call."""
    return [error.kind for error in wire.errors()]


def test_local_bus_frames_reach_every_other_end_in_order(folder: Path) -> None:
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


def test_local_bus_reader_receives_frames_of_several_writers(folder: Path) -> None:
    with join(folder, 4) as (reader, *writers):
        for i in range(100):
            for identifier, wire in enumerate(writers):
                wire.send(CanFrame(identifier, bytes([i])))
        frames = reader.receive()
    for identifier in range(3):
        assert [frame.data[0] for frame in frames if frame.id == identifier] == [*range(100)]


def test_local_bus_end_that_joins_late_receives_later_frames(folder: Path) -> None:
    with join(folder, 1) as (first,):
        for _ in range(200):
            first.send(CanFrame(1, b"too early"))
            with join(folder, 1) as (late,):
                first.send(FRAME)
                assert late.receive() == [FRAME]


def test_local_bus_end_of_classic_can_ignores_other_frames(folder: Path) -> None:
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


@pytest.mark.heavy
def test_local_bus_frozen_reader_delays_no_other_one(folder: Path) -> None:
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
        assert list_error_kinds(reader) == []
        (error,) = writer.errors()
        assert error.kind == "queue_full"
        assert writer.errors() == [], "each lost frame is reported once"

        # The frozen program continues: it receives the frames for which there was space, in order. The next frame
        # contains the number of the lost frames.
        os.kill(frozen.pid, signal.SIGCONT)
        ids, errors = request_report(frozen)
        lost = FLOOD_FRAMES - len(ids)
        assert ids == sent_ids[: len(ids)]
        assert lost > 0
        assert error.detail.startswith(f"{lost} frames")
        assert errors == []
        writer.send(FRAME)
        ids, ((kind, detail),) = request_report(frozen)
        assert ids == [FRAME.id]
        assert kind == "receive_overflow"
        assert detail.startswith(f"{lost} frames")


def test_local_bus_removes_killed_program_and_accepts_another(folder: Path) -> None:
    with join(folder, 1) as (wire,):
        assert list_error_kinds(wire) == [], "a program may be the first on the bus"
        for _ in range(2):
            with run_member(folder) as process:
                wait([wire], 1.0)
                assert wire.receive() == [FRAME]
                assert "interface_down" not in list_error_kinds(wire)
                process.send_signal(signal.SIGKILL)
                process.wait(10)
                assert len([*folder.iterdir()]) == 2, "it could not clean up"
            assert wire.send(FRAME)
            assert [*folder.iterdir()] == [wire._inbox_path]
            assert list_error_kinds(wire) == ["interface_down"]
            assert list_error_kinds(wire) == []
        with join(folder, 1):
            assert list_error_kinds(wire) == ["interface_up"]


def test_local_bus_next_program_removes_files_of_killed_one(folder: Path) -> None:
    with run_member(folder) as process:
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert len([*folder.iterdir()]) == 1
    with raises_error(ConfigError, code="bus/not-available", field="no program is on this bus"):
        validate_channel(f"local:{folder}")
    LocalWire(str(folder)).close()
    assert not folder.exists()


def test_local_bus_last_program_removes_bus_and_remaining_files(folder: Path) -> None:
    with join(folder, 1) as (wire,), run_member(folder) as process:
        wire.send(FRAME)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    assert not folder.exists()


def test_local_bus_skips_bytes_that_are_no_frames(folder: Path) -> None:
    record = RECORD_FORMAT.pack(MAGIC, 0, FRAME.id, len(FRAME.data), FRAME.data)
    too_long = RECORD_FORMAT.pack(MAGIC, 0, 1, 65, b"")
    with join(folder, 1) as (wire,):
        with wire._inbox_path.open("wb", buffering=0) as inbox:
            inbox.write(os.urandom(33).replace(MAGIC, b"") + record + too_long + record[:50])
        assert wire.receive() == [FRAME]
        with wire._inbox_path.open("wb", buffering=0) as inbox:
            inbox.write(record)
        assert wire.receive() == [FRAME]


def test_local_bus_lists_unknown_frames_of_other_programs(folder: Path) -> None:
    """`snakesim drive scan can` listens in this way before it sends a frame."""
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


def test_local_bus_cut_end_neither_sends_nor_receives_during_fault(folder: Path) -> None:
    with join(folder, 2) as (near, far):
        near.inject("cut", begins=True)
        assert not near.send(CanFrame(1, b""))
        far.send(CanFrame(2, b""))
        wait([near], 0.2)
        assert near.receive() == []
        assert list_error_kinds(near) == ["interface_down"]
        near.inject("cut", begins=False)
        near.send(CanFrame(3, b""))
        wait([far], 1.0)
        assert far.receive() == [CanFrame(3, b"")]


def test_local_bus_is_accessible_only_to_its_user(folder: Path) -> None:
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


def test_local_bus_keeps_other_files_of_its_folder(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    log = folder / "log.can"
    log.write_text("a log")
    with join(folder, 2) as (first, second):
        first.send(FRAME)
        assert second.receive() == [FRAME]
    assert log.read_text() == "a log"
    assert [*folder.iterdir()] == [log]


def test_local_bus_without_program_is_refused_with_advice(folder: Path, tmp_path: Path) -> None:
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

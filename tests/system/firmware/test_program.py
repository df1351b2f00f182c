"""One program runs the reference firmware of all modules of a robot; the tests use its bus and its command line."""

import contextlib
import random
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.local_wire import (
    INBOX_BYTES,
    MAGIC,
    RECORD_FORMAT,
    LocalWire,
)
from snakesim_can_backend.emulator.reference_firmware import describe_modules
from snakesim_can_backend.protocol.commands import make_command, make_emergency
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    CanFrame,
    CommandAction,
    Opcode,
    frame_id,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_native.programs import JOINT_MODULES, get_program
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.harness.wait import wait_until

GARBAGE_RECORDS = 5_000
BATCH = 500  # frames, which fit into the smallest inbox


def start_modules(
    folder: Path, *arguments: str, program: Path | None = None
) -> subprocess.Popen[bytes]:
    """Start the program with the four modules of a small robot, and wait until they are on the bus."""
    modules_path = folder / "modules.txt"
    modules_path.write_text(describe_modules(make_can_config(), CanSettings()))
    process = subprocess.Popen(
        [
            program or get_program(JOINT_MODULES),
            "--bus",
            folder / "bus",
            "--modules",
            modules_path,
            *arguments,
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith(b"modules ready: 4 on local:")
    return process


@contextlib.contextmanager
def run_modules(
    folder: Path, *arguments: str, program: Path | None = None
) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """Run the program; yield the folder of its bus and the process, and check at the end that it stops normally."""
    process = start_modules(folder, *arguments, program=program)
    try:
        yield folder / "bus", process
    finally:
        process.terminate()
        assert process.wait(10) == 0
    assert not (folder / "bus").exists()


def receive_until(wire: LocalWire, opcode: Opcode, count: int) -> list[CanFrame]:
    """Receive frames until this number of them has this opcode, and return these."""
    frames: list[CanFrame] = []

    def receive_and_count() -> bool:
        frames.extend(frame for frame in wire.receive() if parse_opcode(frame.id) == opcode)
        return len(frames) >= count

    wait_until(receive_and_count, f"{count} frames {opcode.name}")
    return frames


def list_answering_nodes(wire: LocalWire) -> list[int]:
    """Return the nodes that answer a request for their identity within 0.2 s, once for each answer."""
    wire.receive()
    wire.send(make_command(CommandAction.IDENTIFY))
    frames: list[CanFrame] = []
    for _ in range(20):
        wait([wire], 0.01)
        frames += wire.receive()
    return sorted(
        parse_node(frame.id) for frame in frames if parse_opcode(frame.id) == Opcode.IDENTITY
    )


def test_firmware_program_answers_for_every_module(tmp_path: Path) -> None:
    with run_modules(tmp_path) as (path, _), contextlib.closing(LocalWire(str(path))) as wire:
        receive_until(wire, Opcode.HEARTBEAT, 4)
        assert wire.send(make_command(CommandAction.IDENTIFY))
        identities = receive_until(wire, Opcode.IDENTITY, 4)
    assert [parse_node(frame.id) for frame in identities] == [1, 2, 3, 4]
    serial_numbers = {frame.data[:4] for frame in identities}
    assert len(serial_numbers) == 4


def make_garbage(seed: int) -> Iterator[bytes]:
    """Yield records of random bytes, most of them with an id that modules read, and some with a wrong size."""
    rng = random.Random(seed)
    for _ in range(GARBAGE_RECORDS):
        record = RECORD_FORMAT.pack(
            MAGIC,
            rng.randrange(100),
            rng.randrange(0x900),
            rng.randrange(12),
            rng.randbytes(64),
        )
        yield record + rng.randbytes(rng.choice((0, 0, 0, 7)))
    yield rng.randbytes(4000)
    yield MAGIC + rng.randbytes(30)


def test_firmware_program_that_receives_random_bytes_continues(
    tmp_path: Path, sanitized_modules: Path
) -> None:
    with run_modules(tmp_path, program=sanitized_modules) as (path, _):
        for seed in range(5):
            (inbox_path,) = path.iterdir()
            with inbox_path.open("wb", buffering=0) as inbox:
                for data in make_garbage(seed):
                    inbox.write(data)
        with contextlib.closing(LocalWire(str(path))) as wire:
            wire.send(make_command(CommandAction.REBOOT))
            receive_until(wire, Opcode.HEARTBEAT, 4)
            wire.send(make_command(CommandAction.IDENTIFY))
            receive_until(wire, Opcode.IDENTITY, 4)


@pytest.mark.parametrize("stop_signal", [signal.SIGTERM, signal.SIGKILL])
def test_firmware_program_end_and_restart_are_reported_once(
    tmp_path: Path, stop_signal: signal.Signals
) -> None:
    path = tmp_path / "bus"
    with contextlib.closing(LocalWire(str(path))) as wire:
        for errors_at_start in ([], ["interface_up"]):
            process = start_modules(tmp_path)
            try:
                receive_until(wire, Opcode.HEARTBEAT, 4)
                assert [error.kind for error in wire.errors()] == errors_at_start
            finally:
                process.send_signal(stop_signal)
                process.wait(10)
            wire.send(make_emergency())
            assert [error.kind for error in wire.errors()] == ["interface_down"]
        wire.send(make_emergency())
        assert wire.errors() == []
    assert not path.exists()


def test_firmware_program_is_not_delayed_by_slow_reader(
    tmp_path: Path,
) -> None:
    """A host fills the inbox of a program that does not read. The modules then send to both."""
    filler = CanFrame(frame_id(Opcode.JOINT_STATE, LAST_NODE), b"")
    filler_count = INBOX_BYTES // RECORD_FORMAT.size + 200
    with (
        run_modules(tmp_path) as (path, process),
        contextlib.closing(LocalWire(str(path))) as host,
        contextlib.closing(LocalWire(str(path))) as slow_reader,
    ):
        # While they boot, modules answer no request.
        wait_until(lambda: list_answering_nodes(host) == [1, 2, 3, 4], "answers after the boot")
        for begin in range(0, filler_count, BATCH):
            for _ in range(min(BATCH, filler_count - begin)):
                host.send(filler)
            host.send(make_command(CommandAction.IDENTIFY))
            receive_until(host, Opcode.IDENTITY, 4)  # the modules have read the batch
        receive_until(host, Opcode.HEARTBEAT, 8)
        while slow_reader.receive():
            pass
        receive_until(slow_reader, Opcode.HEARTBEAT, 4)
        (lost_at_reader,) = [
            error for error in slow_reader.errors() if error.kind == "receive_overflow"
        ]
        assert int(lost_at_reader.detail.split()[0]) >= 8
        process.terminate()
        assert process.stdout is not None
        output = process.stdout.read()
        assert b"were lost by programs that do not read" in output
        assert b"the modules read too slowly" not in output


def test_firmware_program_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    with run_modules(tmp_path, "--until-input-ends") as (_, process):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(10) == 0


def test_firmware_programs_with_equal_ids_both_answer(tmp_path: Path) -> None:
    """A bus cannot refuse a second robot. Each of its modules answers, which the driver reports as a duplicate."""
    with run_modules(tmp_path) as (path, _), contextlib.closing(LocalWire(str(path))) as wire:
        second = start_modules(tmp_path)
        try:
            wait_until(
                lambda: list_answering_nodes(wire) == [1, 1, 2, 2, 3, 3, 4, 4],
                "answers of both programs to one request",
            )
        finally:
            second.terminate()
            assert second.wait(10) == 0


def test_firmware_program_refuses_folder_of_other_users(tmp_path: Path) -> None:
    folder = tmp_path / "bus"
    folder.mkdir(mode=0o755)
    (tmp_path / "modules.txt").write_text(describe_modules(make_can_config(), CanSettings()))
    command = [get_program(JOINT_MODULES), "--bus", folder, "--modules", tmp_path / "modules.txt"]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    assert refused.returncode == 2
    assert "only this user" in refused.stderr
    assert [*folder.iterdir()] == []


@pytest.mark.parametrize(
    "text", ["", "joint_1 node 70\n", "joint_1 node 1 speed 3\n", "joint_1 node 1 serial\n"]
)
def test_firmware_program_refuses_invalid_description(tmp_path: Path, text: str) -> None:
    (tmp_path / "modules.txt").write_text(text)
    command = [
        get_program(JOINT_MODULES),
        "--bus",
        tmp_path / "bus",
        "--modules",
        tmp_path / "modules.txt",
    ]
    assert subprocess.run(command, capture_output=True, timeout=10, check=False).returncode == 2

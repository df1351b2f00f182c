"""The program that runs the reference firmware for a whole robot, on its bus and at its command line."""

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
    """The program and the folder of its bus. At the end it is stopped, and must not have failed."""
    process = start_modules(folder, *arguments, program=program)
    try:
        yield folder / "bus", process
    finally:
        process.terminate()
        assert process.wait(10) == 0
    assert not (folder / "bus").exists()


def receive_until(wire: LocalWire, opcode: Opcode, count: int) -> list[CanFrame]:
    frames: list[CanFrame] = []

    def receive() -> bool:
        frames.extend(frame for frame in wire.receive() if parse_opcode(frame.id) == opcode)
        return len(frames) >= count

    wait_until(receive, f"{count} frames {opcode.name}")
    return frames


def list_answering_nodes(wire: LocalWire) -> list[int]:
    """The nodes that answer a request for their identity within a moment, once for each answer."""
    wire.receive()
    wire.send(make_command(CommandAction.IDENTIFY))
    frames: list[CanFrame] = []
    for _ in range(20):
        wait([wire], 0.01)
        frames += wire.receive()
    return sorted(
        parse_node(frame.id) for frame in frames if parse_opcode(frame.id) == Opcode.IDENTITY
    )


def test_every_module_answers_on_its_bus(tmp_path: Path) -> None:
    with run_modules(tmp_path) as (path, _), contextlib.closing(LocalWire(str(path))) as wire:
        receive_until(wire, Opcode.HEARTBEAT, 4)
        assert wire.send(make_command(CommandAction.IDENTIFY))
        identities = receive_until(wire, Opcode.IDENTITY, 4)
    assert [parse_node(frame.id) for frame in identities] == [1, 2, 3, 4]
    assert len({frame.data[:4] for frame in identities}) == 4, "serial numbers"


def make_garbage(seed: int) -> Iterator[bytes]:
    """Records of random bytes, most of them with an id that modules read, and some of a wrong size."""
    choose = random.Random(seed)
    for _ in range(GARBAGE_RECORDS):
        record = RECORD_FORMAT.pack(
            MAGIC,
            choose.randrange(100),
            choose.randrange(0x900),
            choose.randrange(12),
            choose.randbytes(64),
        )
        yield record + choose.randbytes(choose.choice((0, 0, 0, 7)))
    yield choose.randbytes(4000)
    yield MAGIC + choose.randbytes(30)


def test_random_bytes_do_it_no_harm(tmp_path: Path, sanitized_modules: Path) -> None:
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
def test_the_end_of_the_program_is_reported_once_and_its_restart_too(
    tmp_path: Path, stop_signal: signal.Signals
) -> None:
    path = tmp_path / "bus"
    with contextlib.closing(LocalWire(str(path))) as wire:
        for at_start in ([], ["interface_up"]):
            process = start_modules(tmp_path)
            try:
                receive_until(wire, Opcode.HEARTBEAT, 4)
                assert [error.kind for error in wire.errors()] == at_start
            finally:
                process.send_signal(stop_signal)
                process.wait(10)
            wire.send(make_emergency())
            assert [error.kind for error in wire.errors()] == ["interface_down"]
        wire.send(make_emergency())
        assert wire.errors() == []
    assert not path.exists()


def test_it_sends_to_several_programs_and_one_that_does_not_read_delays_no_other(
    tmp_path: Path,
) -> None:
    """A host fills the inbox of a program that does not read. The modules then send to both."""
    filler = CanFrame(frame_id(Opcode.JOINT_STATE, LAST_NODE), b"")
    fillers = INBOX_BYTES // RECORD_FORMAT.size + 200
    with (
        run_modules(tmp_path) as (path, process),
        contextlib.closing(LocalWire(str(path))) as host,
        contextlib.closing(LocalWire(str(path))) as deaf,
    ):
        # While they boot, modules answer no request.
        wait_until(lambda: list_answering_nodes(host) == [1, 2, 3, 4], "answers after the boot")
        for begin in range(0, fillers, BATCH):
            for _ in range(min(BATCH, fillers - begin)):
                host.send(filler)
            host.send(make_command(CommandAction.IDENTIFY))
            receive_until(host, Opcode.IDENTITY, 4)  # the modules have read the batch
        receive_until(host, Opcode.HEARTBEAT, 8)
        while deaf.receive():
            pass
        receive_until(deaf, Opcode.HEARTBEAT, 4)
        (lost_at_reader,) = [error for error in deaf.errors() if error.kind == "receive_overflow"]
        assert int(lost_at_reader.detail.split()[0]) >= 8
        process.terminate()
        assert process.stdout is not None
        output = process.stdout.read()
        assert b"were lost by programs that do not read" in output
        assert b"the modules read too slowly" not in output


def test_the_program_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    with run_modules(tmp_path, "--until-input-ends") as (_, process):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(10) == 0


def test_modules_of_two_programs_with_the_same_ids_are_seen(tmp_path: Path) -> None:
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


def test_a_folder_that_other_users_can_enter_is_refused(tmp_path: Path) -> None:
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
def test_a_wrong_description_is_wrong_input(tmp_path: Path, text: str) -> None:
    (tmp_path / "modules.txt").write_text(text)
    command = [
        get_program(JOINT_MODULES),
        "--bus",
        tmp_path / "bus",
        "--modules",
        tmp_path / "modules.txt",
    ]
    assert subprocess.run(command, capture_output=True, timeout=10, check=False).returncode == 2

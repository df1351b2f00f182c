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

MODULE_COUNT = 4  # of the small robot whose modules the program runs
NODES = [1, 2, 3, 4]  # of these modules
GARBAGE_SEEDS = range(5)
GARBAGE_RECORDS = 5_000  # for each seed
BATCH = 500  # frames, which fit into the smallest inbox


def start_modules(
    folder: Path, *arguments: str, program: Path | None = None
) -> subprocess.Popen[bytes]:
    """Start the program with the modules of a small robot, and wait until they are on the bus."""
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
        receive_until(wire, Opcode.HEARTBEAT, MODULE_COUNT)

        assert wire.send(make_command(CommandAction.IDENTIFY))
        identities = receive_until(wire, Opcode.IDENTITY, MODULE_COUNT)

    assert [parse_node(frame.id) for frame in identities] == NODES
    serial_numbers = {frame.data[:4] for frame in identities}
    assert len(serial_numbers) == MODULE_COUNT, "two modules have the same serial number"


def make_garbage(seed: int) -> Iterator[bytes]:
    """Yield what an inbox must survive: records with random contents, bytes between them, and a truncated record."""
    rng = random.Random(seed)
    for _ in range(GARBAGE_RECORDS):
        record = RECORD_FORMAT.pack(
            MAGIC,
            rng.randrange(100),  # frames that the writer lost
            rng.randrange(0x900),  # id: most of them are standard ids, which end at 0x7FF
            rng.randrange(12),  # length of the data; a classic frame has at most 8 bytes
            rng.randbytes(64),
        )
        bytes_between_records = rng.randbytes(rng.choice((0, 0, 0, 7)))
        yield record + bytes_between_records
    bytes_without_record = rng.randbytes(4000)
    yield bytes_without_record
    truncated_record = MAGIC + rng.randbytes(30)
    yield truncated_record


def write_into_only_inbox(bus_folder: Path, contents: Iterator[bytes]) -> None:
    """Write raw bytes to the modules, which have the only inbox on their bus."""
    (inbox_path,) = bus_folder.iterdir()
    with inbox_path.open("wb", buffering=0) as inbox:
        for content in contents:
            inbox.write(content)


def test_firmware_program_that_receives_random_bytes_continues(
    tmp_path: Path, sanitized_modules: Path
) -> None:
    """The program is compiled with sanitizers, so that a wrong memory access ends it."""
    with run_modules(tmp_path, program=sanitized_modules) as (bus_folder, _):
        for seed in GARBAGE_SEEDS:
            write_into_only_inbox(bus_folder, make_garbage(seed))

        with contextlib.closing(LocalWire(str(bus_folder))) as wire:
            # Some random bytes are valid commands. A restart brings the modules into a known state.
            wire.send(make_command(CommandAction.REBOOT))
            # While they boot, modules answer no request. Their heartbeats may be older than the restart.
            wait_until(lambda: list_answering_nodes(wire) == NODES, "answers after the boot")


@pytest.mark.parametrize("stop_signal", [signal.SIGTERM, signal.SIGKILL])
def test_firmware_program_end_and_restart_are_reported_once(
    tmp_path: Path, stop_signal: signal.Signals
) -> None:
    path = tmp_path / "bus"
    errors_at_first_start: list[str] = []
    errors_at_restart = ["interface_up"]
    with contextlib.closing(LocalWire(str(path))) as wire:
        for errors_at_start in (errors_at_first_start, errors_at_restart):
            process = start_modules(tmp_path)
            try:
                receive_until(wire, Opcode.HEARTBEAT, MODULE_COUNT)
                assert [error.kind for error in wire.errors()] == errors_at_start
            finally:
                process.send_signal(stop_signal)
                process.wait(10)
            wire.send(make_emergency())
            assert [error.kind for error in wire.errors()] == ["interface_down"]

        wire.send(make_emergency())
        assert wire.errors() == [], "the same end is reported again"
    assert not path.exists()


def test_firmware_program_is_not_delayed_by_slow_reader(
    tmp_path: Path,
) -> None:
    """A host fills the inbox of a program that does not read. The modules then send to both."""
    filler = CanFrame(frame_id(Opcode.JOINT_STATE, LAST_NODE), b"")  # modules ignore it
    filler_count = INBOX_BYTES // RECORD_FORMAT.size + 200  # 200 more than fit into an inbox
    heartbeat_count = 2 * MODULE_COUNT  # two of each module, which the slow reader loses
    with (
        run_modules(tmp_path) as (path, process),
        contextlib.closing(LocalWire(str(path))) as host,
        contextlib.closing(LocalWire(str(path))) as slow_reader,
    ):
        # While they boot, modules answer no request.
        wait_until(lambda: list_answering_nodes(host) == NODES, "answers after the boot")

        for begin in range(0, filler_count, BATCH):
            for _ in range(min(BATCH, filler_count - begin)):
                host.send(filler)
            host.send(make_command(CommandAction.IDENTIFY))
            # When they answer, the modules have read the batch.
            receive_until(host, Opcode.IDENTITY, MODULE_COUNT)
        receive_until(host, Opcode.HEARTBEAT, heartbeat_count)
        while slow_reader.receive():
            pass
        receive_until(slow_reader, Opcode.HEARTBEAT, MODULE_COUNT)

        (lost_at_reader,) = [
            error for error in slow_reader.errors() if error.kind == "receive_overflow"
        ]
        lost_count = int(lost_at_reader.detail.split()[0])
        assert lost_count >= heartbeat_count
        process.terminate()
        assert process.stdout is not None
        output = process.stdout.read()
        assert b"were lost by programs that do not read" in output
        assert b"the modules read too slowly" not in output


def test_firmware_program_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    with run_modules(tmp_path, "--until-input-ends") as (_, process):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(10) == 0, "the program must not outlive the process that started it"


def test_firmware_programs_with_equal_ids_both_answer(tmp_path: Path) -> None:
    """A bus cannot refuse a second robot. Each of its modules answers, which the driver reports as a duplicate."""
    with run_modules(tmp_path) as (path, _), contextlib.closing(LocalWire(str(path))) as wire:
        second = start_modules(tmp_path)
        try:
            wait_until(
                lambda: list_answering_nodes(wire) == sorted(2 * NODES),
                "answers of both programs to one request",
            )
        finally:
            second.terminate()
            assert second.wait(10) == 0


def test_firmware_program_refuses_folder_of_other_users(tmp_path: Path) -> None:
    folder = tmp_path / "bus"
    folder.mkdir(mode=0o755)  # other users may read it
    (tmp_path / "modules.txt").write_text(describe_modules(make_can_config(), CanSettings()))
    command = [get_program(JOINT_MODULES), "--bus", folder, "--modules", tmp_path / "modules.txt"]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    assert refused.returncode == 2
    assert "only this user" in refused.stderr
    assert [*folder.iterdir()] == [], "the program has put an inbox into the folder"


@pytest.mark.parametrize(
    "text",
    ["", "joint_1 node 70\n", "joint_1 node 1 speed 3\n", "joint_1 node 1 serial\n"],
    ids=["no module", "node beyond the last", "unknown key", "key without value"],
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

    refused = subprocess.run(command, capture_output=True, timeout=10, check=False)

    assert refused.returncode == 2

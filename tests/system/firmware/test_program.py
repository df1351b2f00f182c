"""The program that runs the reference firmware for a whole robot, on its socket and at its command line."""

import contextlib
import random
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_can_backend.bus.unix_wire import UnixWire
from snakesim_can_backend.emulator.reference_firmware import describe_modules
from snakesim_can_backend.protocol.commands import make_command, make_emergency
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_native.programs import JOINT_MODULES, get_program
from snakesim_testing.can.driver_loop import config
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

GARBAGE_RECORDS = 5_000


@contextlib.contextmanager
def run_modules(
    folder: Path, *arguments: str, program: Path | None = None
) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """The program with the four modules of a small robot; at the end it is stopped, and must not have failed."""
    path = folder / "bus.sock"
    modules_path = folder / "modules.txt"
    modules_path.write_text(describe_modules(config(), CanSettings()))
    process = subprocess.Popen(
        [
            program or get_program(JOINT_MODULES),
            "--socket",
            path,
            "--modules",
            modules_path,
            *arguments,
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    wait_until(path.is_socket, "the socket of the modules")
    try:
        yield path, process
    finally:
        process.terminate()
        assert process.wait(10) == 0
    assert not path.exists()


def receive_until(wire: UnixWire, opcode: Opcode, count: int) -> list[CanFrame]:
    frames: list[CanFrame] = []

    def receive() -> bool:
        frames.extend(frame for frame in wire.receive() if parse_opcode(frame.id) == opcode)
        return len(frames) >= count

    wait_until(receive, f"{count} frames {opcode.name}")
    return frames


def test_every_module_answers_at_its_socket(tmp_path: Path) -> None:
    with run_modules(tmp_path) as (path, _), contextlib.closing(UnixWire(str(path))) as wire:
        receive_until(wire, Opcode.HEARTBEAT, 4)
        assert wire.send(make_command(CommandAction.IDENTIFY))
        identities = receive_until(wire, Opcode.IDENTITY, 4)
    assert [parse_node(frame.id) for frame in identities] == [1, 2, 3, 4]
    assert len({frame.data[:4] for frame in identities}) == 4, "serial numbers"


def make_garbage(seed: int) -> bytes:
    """Records of random bytes, most of them with an id that modules read, then an incomplete one."""
    choose = random.Random(seed)
    records = [
        choose.randrange(0x900).to_bytes(4, "little")
        + bytes((choose.randrange(12),))
        + choose.randbytes(11)
        for _ in range(GARBAGE_RECORDS)
    ]
    return b"".join(records) + choose.randbytes(7)


def test_random_bytes_do_it_no_harm(tmp_path: Path, sanitized_modules: Path) -> None:
    with run_modules(tmp_path, program=sanitized_modules) as (path, _):
        for seed in range(5):
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(path))
                with contextlib.suppress(BrokenPipeError):
                    client.sendall(make_garbage(seed))
        with contextlib.closing(UnixWire(str(path))) as wire:
            wire.send(make_command(CommandAction.REBOOT))
            receive_until(wire, Opcode.HEARTBEAT, 4)
            wire.send(make_command(CommandAction.IDENTIFY))
            receive_until(wire, Opcode.IDENTITY, 4)


def test_the_end_of_the_program_is_reported_once(tmp_path: Path) -> None:
    with run_modules(tmp_path) as (path, process):
        wire = UnixWire(str(path))
        process.terminate()
        process.wait(10)
    wait_until(lambda: wire.receive() == [] and wire.fileno() is None, "the end of the stream")
    assert [error.kind for error in wire.errors()] == ["interface_down"]
    assert not wire.send(make_emergency())
    assert wire.errors() == []
    assert wire.idle() is None
    wire.close()


def test_the_program_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    with run_modules(tmp_path, "--until-input-ends") as (_, process):
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(10) == 0


def test_two_programs_cannot_share_a_socket(tmp_path: Path) -> None:
    with run_modules(tmp_path) as (path, _):
        command = [
            get_program(JOINT_MODULES),
            "--socket",
            path,
            "--modules",
            tmp_path / "modules.txt",
        ]
        second = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
        assert second.returncode == 2
        assert "another process" in second.stderr
        assert path.is_socket()


@pytest.mark.parametrize(
    "text", ["", "joint_1 node 70\n", "joint_1 node 1 speed 3\n", "joint_1 node 1 serial\n"]
)
def test_a_wrong_description_is_wrong_input(tmp_path: Path, text: str) -> None:
    (tmp_path / "modules.txt").write_text(text)
    command = [
        get_program(JOINT_MODULES),
        "--socket",
        tmp_path / "bus.sock",
        "--modules",
        tmp_path / "modules.txt",
    ]
    assert subprocess.run(command, capture_output=True, timeout=10, check=False).returncode == 2


def test_a_socket_that_is_missing_or_unused_is_refused(tmp_path: Path) -> None:
    with raises_error(ConfigError, code="bus/not-available"):
        UnixWire(str(tmp_path / "bus.sock"))
    with raises_error(ConfigError, code="bus/invalid-channel"):
        UnixWire("x" * 108)
    with socket.socket(socket.AF_UNIX) as unused:
        unused.bind(str(tmp_path / "unused.sock"))
    with raises_error(BackendError, code="bus/cannot-open"):
        UnixWire(str(tmp_path / "unused.sock"))

"""The expanded DBC file has every message of every node, and cantools decodes the driver's logs with it."""

import io
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from cantools.database.can import Database, Message

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.bus.log import LoggedWire
from snakesim_can_backend.commands import COMMANDS
from snakesim_can_backend.protocol import commands
from snakesim_can_backend.protocol.codec import load_database, load_layouts
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    NODE_BITS,
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
)
from snakesim_can_backend.protocol.expanded import list_nodes
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.operator.registered_command import run_registered_command


@pytest.fixture(scope="module")
def expanded_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide the file that `snakesim drive dbc` writes."""
    path = tmp_path_factory.mktemp("dbc") / "expanded.dbc"
    assert run_registered_command(COMMANDS, ["drive", "dbc", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def database(expanded_file: Path) -> Database:
    """Provide the content of the expanded file."""
    database = cantools.database.load_file(expanded_file)
    assert isinstance(database, Database)
    return database


@pytest.mark.slow
def test_expanded_file_has_exactly_the_messages_of_every_node(database: Database) -> None:
    expected = {
        opcode << NODE_BITS | node: layout.name
        if node == BROADCAST
        else f"{layout.name}_{node:02d}"
        for opcode, layout in load_layouts().items()
        for node in list_nodes(opcode)
    }
    assert {message.frame_id: message.name for message in database.messages} == expected


@pytest.mark.heavy
def test_expanded_file_signals_are_equal_for_every_node(database: Database) -> None:
    original_messages = {message.name: message for message in load_database().messages}
    for message in database.messages:
        original = original_messages[message.name.partition("_")[0]]
        assert message.length == original.length
        assert message.senders == original.senders
        assert get_signal_layouts(message) == get_signal_layouts(original)


def get_signal_layouts(message: Message) -> dict[str, tuple[object, ...]]:
    """Return, for each signal, everything that a decoder needs."""
    return {
        signal.name: (
            signal.start,
            signal.length,
            signal.is_signed,
            signal.conversion.scale,
            signal.conversion.offset,
            signal.conversion.is_float,
            signal.unit,
            signal.minimum,
            signal.maximum,
            signal.choices,
            signal.multiplexer_ids,
        )
        for signal in message.signals
    }


def make_frames_and_texts() -> list[tuple[CanFrame, str]]:
    """Make frames of every kind, each with the text into which cantools must decode it."""
    layouts = load_layouts()
    setpoint = layouts[Opcode.SET_POINT].encode(
        5, mode=JointMode.POSITION, count=3, position=-0.5, torque_limit=7.0
    )
    state = layouts[Opcode.JOINT_STATE].encode(
        62, angle=1.0, velocity=-2.0, torque=0.5, count=3, state=ModuleState.ARMED, derated=1
    )
    return [
        (commands.make_emergency(), "Emergency(reason: host)"),
        (
            commands.make_command(CommandAction.ARM),
            "Command(action: arm, key: 23214, checksum: 50)",
        ),
        (commands.make_command(CommandAction.STOP, 7), "Command_07(action: stop"),
        (commands.make_sync(200, 12345678), "Sync(count: 200, time: 12345678 us)"),
        (
            setpoint,
            "SetPoint_05(mode: position, count: 3, position: -0.5 rad, torque_limit: 7.0 N.m",
        ),
        (
            state,
            "JointState_62(angle: 1.0 rad, velocity: -2.0 rad/s, torque: 0.5 N.m, count: 3, state: armed",
        ),
    ]


@pytest.mark.slow
def test_expanded_file_lets_cantools_decode_a_log(expanded_file: Path) -> None:
    log = io.StringIO()
    wire = LoggedWire(VirtualWire("expanded-log"), log)
    other = VirtualWire("expanded-log")
    frames = make_frames_and_texts()
    for i, (frame, _) in enumerate(frames):
        if i % 2:
            wire.send(frame)
        else:
            other.send(frame)
            assert wire.receive() == [frame]
    wire.close()
    other.close()
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(expanded_file)]
    result = subprocess.run(
        command, input=log.getvalue(), capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result.stderr
    for line, (_, text) in zip(result.stdout.splitlines(), frames, strict=True):
        assert text in line

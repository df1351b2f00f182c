"""The spelled-out DBC file has every message of every node, and stock cantools reads our logs with it."""

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
    FIRST_NODE,
    LAST_NODE,
    NODE_BITS,
    CanFrame,
    CommandAction,
    ModuleState,
    Opcode,
)
from snakesim_can_backend.protocol.expanded import list_nodes
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.operator.registered_command import run_registered_command

EVERYBODY = list(range(FIRST_NODE, LAST_NODE + 1))


@pytest.fixture(scope="module")
def expanded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file, as `snakesim drive dbc` writes it."""
    path = tmp_path_factory.mktemp("dbc") / "expanded.dbc"
    assert run_registered_command(COMMANDS, ["drive", "dbc", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def database(expanded: Path) -> Database:
    database = cantools.database.load_file(expanded)
    assert isinstance(database, Database)
    return database


@pytest.mark.slow
def test_every_message_of_every_node_is_there_and_no_other(database: Database) -> None:
    expected = {
        opcode << NODE_BITS | node: layout.name
        if node == BROADCAST
        else f"{layout.name}_{node:02d}"
        for opcode, layout in load_layouts().items()
        for node in list_nodes(opcode)
    }
    assert {message.frame_id: message.name for message in database.messages} == expected


def test_signals_are_the_same_for_every_node(database: Database) -> None:
    source = {message.name: message for message in load_database().messages}
    for message in database.messages:
        original = source[message.name.partition("_")[0]]
        assert message.length == original.length
        assert message.senders == original.senders
        assert layout_of(message) == layout_of(original)


def layout_of(message: Message) -> dict[str, tuple[object, ...]]:
    """Everything that a decoder needs of each signal."""
    return {
        s.name: (
            *(
                s.start,
                s.length,
                s.is_signed,
                s.conversion.scale,
                s.conversion.offset,
                s.conversion.is_float,
            ),
            *(s.unit, s.minimum, s.maximum, s.choices, s.multiplexer_ids),
        )
        for s in message.signals
    }


def sent() -> list[tuple[CanFrame, str]]:
    """Frames of every kind, and what stock cantools is to say of them."""
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
def test_stock_cantools_decodes_our_log(expanded: Path) -> None:
    log = io.StringIO()
    wire = LoggedWire(VirtualWire("expanded-log"), log)
    other = VirtualWire("expanded-log")
    frames = sent()
    for i, (frame, _) in enumerate(frames):
        if i % 2:
            wire.send(frame)
        else:
            other.send(frame)
            assert wire.receive() == [frame]
    wire.close()
    other.close()
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(expanded)]
    done = subprocess.run(command, input=log.getvalue(), capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    for line, (_, words) in zip(done.stdout.splitlines(), frames, strict=True):
        assert words in line

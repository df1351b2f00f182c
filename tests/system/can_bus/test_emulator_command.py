"""`snakesim drive emulate can` puts modules on a bus, refuses invalid input, and explains each fault in its help."""

import re
import uuid
from collections import defaultdict

import can
import pytest

from snakesim_can_backend.bus.bus import to_python_can
from snakesim_can_backend.commands import COMMANDS
from snakesim_can_backend.emulator import command as program
from snakesim_can_backend.emulator.command import main
from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS
from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import (
    CommandAction,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_hal.programs.commands import Command


def test_emulator_command_answers_for_every_module_and_reports_traffic(monkeypatch, capsys):
    # These functions would change the process of the tests.
    for function in ("call_on_stop_signals", "tune_garbage_collector"):
        monkeypatch.setattr(program, function, lambda *_: None)
    channel = f"modules-{uuid.uuid4().hex[:8]}"
    with can.Bus(interface="virtual", channel=channel) as bus:
        identify_task = bus.send_periodic(to_python_can(make_command(CommandAction.IDENTIFY)), 0.1)
        bus_options = ("--channel", f"virtual:{channel}", "--physics-model", "inertia")
        run_options = ("--pose", "none", "--duration", "2", "--stats", "--fault", "leak:joint_3@0")
        assert main(["triplet", *bus_options, *run_options]) == 0
        identify_task.stop()
        received = defaultdict(set)
        while (message := bus.recv(0)) is not None:
            opcode = parse_opcode(message.arbitration_id)
            node = parse_node(message.arbitration_id)
            received[opcode, node].add(bytes(message.data[:4]))
    nodes = range(1, 14)
    assert all(received[Opcode.HEARTBEAT, node] for node in nodes)
    serials = set.union(*(received[Opcode.IDENTITY, node] for node in nodes))
    assert len(serials) == 13
    printed = capsys.readouterr().out
    assert printed.startswith(f"modules ready: 13 on virtual:{channel}\n")
    for pattern in (
        r"load virtual:\S+ \d",
        r"% of 1 Mbit/s; longest",
        r"  identity  +\d+ frames",
        "fault: 0.00 s leak:joint_3",
    ):
        assert re.search(pattern, printed), f"{pattern} is not in {printed}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["triplet", "--channel", "can0"], "--on-real-bus"),
        (["nowhere"], "nowhere"),
        (["triplet", "--pose", "7450"], "HOST:PORT"),
        (["triplet", "--set", "robot.chain.modules=70"], "70 joints"),
        (["triplet", "--channel", "vcan77"], "vcan77"),
        # The command checks faults before it opens an interface.
        (["triplet", "--channel", "vcan77", "--fault", "mute:joint_14@1"], "joint_13"),
    ],
)
def test_emulator_command_with_invalid_input_is_refused_with_reason(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_emulator_command_help_explains_every_fault():
    (emulate_command,) = (
        command
        for command in COMMANDS
        if isinstance(command, Command) and command.name == "drive emulate can"
    )
    assert all(kind in emulate_command.details for kind in FAULT_DESCRIPTIONS)

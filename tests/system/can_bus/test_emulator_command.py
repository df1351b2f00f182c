"""`snakesim drive emulate can`: a bus with its modules on it, what it refuses, and help that names each fault."""

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
    for of_a_process in ("call_on_stop_signals", "tune_garbage_collector"):
        monkeypatch.setattr(program, of_a_process, lambda *_: None)
    channel = f"modules-{uuid.uuid4().hex[:8]}"
    with can.Bus(interface="virtual", channel=channel) as bus:
        asking = bus.send_periodic(to_python_can(make_command(CommandAction.IDENTIFY)), 0.1)
        where = ("--channel", f"virtual:{channel}", "--physics-model", "inertia", "--pose", "none")
        assert (
            main(["triplet", *where, "--duration", "2", "--stats", "--fault", "leak:joint_3@0"])
            == 0
        )
        asking.stop()
        heard = defaultdict(set)
        while (message := bus.recv(0)) is not None:
            heard[parse_opcode(message.arbitration_id), parse_node(message.arbitration_id)].add(
                bytes(message.data[:4])
            )
    nodes = range(1, 14)
    assert all(heard[Opcode.HEARTBEAT, node] for node in nodes)
    assert len(set.union(*(heard[Opcode.IDENTITY, node] for node in nodes))) == 13, (
        "each has a serial of its own"
    )
    said = capsys.readouterr().out
    assert said.startswith(f"modules ready: 13 on virtual:{channel}\n")
    for words in (
        r"load virtual:\S+ \d",
        r"% of 1 Mbit/s; longest",
        r"  identity  +\d+ frames",
        "fault: 0.00 s leak:joint_3",
    ):
        assert re.search(words, said), f"{words} is not in {said}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["triplet", "--channel", "can0"], "--on-real-bus"),
        (["nowhere"], "nowhere"),
        (["triplet", "--pose", "7450"], "HOST:PORT"),
        (["triplet", "--set", "robot.chain.modules=70"], "70 joints"),
        (["triplet", "--channel", "vcan77"], "vcan77"),
        # Faults are checked before an interface is touched.
        (["triplet", "--channel", "vcan77", "--fault", "mute:joint_14@1"], "joint_13"),
    ],
)
def test_wrong_input_is_told_and_nothing_starts(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_help_explains_every_fault():
    (command,) = (
        one for one in COMMANDS if isinstance(one, Command) and one.name == "drive emulate can"
    )
    assert all(kind in command.details for kind in FAULT_DESCRIPTIONS)

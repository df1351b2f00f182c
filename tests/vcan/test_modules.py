"""`snakesim modules` as a process on the kernel's virtual CAN bus."""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from snakesim_can_backend.bus.bus import SocketCanWire, wait
from snakesim_can_backend.protocol.codec import codec
from snakesim_can_backend.protocol.definitions import COMMAND_KEY, Action, Frame, Opcode, node_of, opcode_of

pytestmark = pytest.mark.slow
START_LIMIT_S, ANSWER_LIMIT_S = 90.0, 20.0  # an emulated machine is slow
COMMAND = "snakesim_can_backend.twin.command"


def started(channel: str, *arguments: str) -> subprocess.Popen[str]:
    parent = ["--parent", str(os.getpid())]
    process = subprocess.Popen(
        [sys.executable, "-m", COMMAND, "triplet", "--channel", channel, "--plant", "inertia", *parent, *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert select.select([process.stdout], [], [], START_LIMIT_S)[0], "not ready in time"
    assert process.stdout.readline() == f"modules ready: 13 on {channel}\n"
    return process


@pytest.fixture
def bus(channel: str) -> Iterator[SocketCanWire]:
    wire = SocketCanWire(channel)
    yield wire
    wire.close()


def heard(bus: SocketCanWire, opcode: Opcode, nodes: int) -> dict[int, Frame]:
    """Frames of one message until so many nodes have sent it."""
    found: dict[int, Frame] = {}
    end = time.monotonic() + ANSWER_LIMIT_S
    while len(found) < nodes and time.monotonic() < end:
        wait([bus], 0.1)
        found |= {node_of(f.id): f for f in bus.receive() if opcode_of(f.id) == opcode}
    return found


@pytest.mark.parametrize("how", [[], ["--stepped"]])
def test_every_module_answers_and_the_process_ends_in_order(bus: SocketCanWire, how: list[str]) -> None:
    process = started(bus.channel, *how)
    try:
        if not how:
            assert len(heard(bus, Opcode.HEARTBEAT, 13)) == 13
        bus.send(codec()[Opcode.COMMAND].frame(0, action=Action.IDENTIFY, key=COMMAND_KEY))
        identities = heard(bus, Opcode.IDENTITY, 13)
        assert sorted(identities) == list(range(1, 14))
        assert len({frame.data[:4] for frame in identities.values()}) == 13
        bus.send(codec()[Opcode.SYNC].frame(0, count=5, time=0))
        assert all(frame.data[6] & 15 == 5 for frame in heard(bus, Opcode.JOINT_STATE, 13).values())
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=ANSWER_LIMIT_S)
        assert process.returncode == 0
        assert "identity" in out and "of 1 Mbit/s" in out
    finally:
        process.kill()
        process.wait()

"""Emulators served: over python-can's virtual bus, by the clock and stepped, and what a hiccup does not look like."""

import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from snakesim_can_backend.bus.bus import VirtualWire, wait
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.server import EmulatorServer, InProcessEmulators
from snakesim_can_backend.protocol.commands import make_command, make_sync
from snakesim_can_backend.protocol.definitions import CanFrame, CommandAction, ModuleState, Opcode
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.module_rig import decode_frames_of, make_chain, make_setpoint
from snakesim_testing.messages import raises_error

Wall = tuple[VirtualWire, EmulatorServer, Callable[[float], list[CanFrame]]]
JOINTS = 4


@contextmanager
def served(made: ModuleChain) -> Iterator[Wall]:
    """The host's wire, the server, and a function that lets it run until a time in s."""
    name = f"test-{uuid.uuid4().hex[:8]}"
    near, far = VirtualWire(name), VirtualWire(name)
    server = EmulatorServer([far], made)
    now_s = 0.0

    def until(end_s: float) -> list[CanFrame]:
        nonlocal now_s
        while True:
            pause_s = server.run_due(round(now_s * 1e9))
            if pause_s is None or now_s + pause_s > end_s:
                now_s = end_s
                server.run_due(round(now_s * 1e9))
                return near.receive()
            now_s += pause_s

    try:
        yield near, server, until
    finally:
        near.close()
        far.close()


def send_tick(near: VirtualWire, tick: int) -> None:
    near.send(make_sync(tick, 0))
    for node in range(1, JOINTS + 1):
        near.send(make_setpoint(tick, JointMode.POSITION, 0.2, node_id=node))


def test_server_modules_boot_follow_setpoints_and_stop_after_watchdog():
    made = make_chain(is_stepped=False)
    with served(made) as (near, _, until):
        assert until(0.09) == []
        assert len(decode_frames_of(until(0.11), Opcode.HEARTBEAT)) == JOINTS
        near.send(make_command(CommandAction.ARM))
        answers = []
        for tick in range(50):
            send_tick(near, tick)
            answers += until(0.11 + 0.01 * (tick + 1))
        states = decode_frames_of(answers, Opcode.JOINT_STATE, 1)
        assert [s["count"] for s in states] == [tick % 16 for tick in range(50)]
        assert states[-1]["angle"] == pytest.approx(0.2, abs=0.01)
        until(0.69)
        assert [slot.module.state for slot in made.slots] == [ModuleState.ARMED] * JOINTS
        until(0.705)
        assert [slot.module.state for slot in made.slots] == [ModuleState.FAULT] * JOINTS


def test_server_pause_does_not_look_like_a_host_pause():
    made = make_chain(is_stepped=False)
    with served(made) as (near, server, until):
        until(0.11)
        near.send(make_command(CommandAction.ARM))
        for tick in range(5):
            send_tick(near, tick)
            until(0.11 + 0.01 * (tick + 1))
        for tick in range(5, 20):  # the host goes on while the server sleeps for 150 ms
            send_tick(near, tick)
        server.run_due(round(0.31e9))
        assert [slot.module.state for slot in made.slots] == [ModuleState.ARMED] * JOINTS


def test_stepped_twins_run_when_the_host_has_nothing_to_do():
    made = make_chain()
    name = f"test-{uuid.uuid4().hex[:8]}"
    far = VirtualWire(name)
    server = EmulatorServer([far], made)
    near = VirtualWire(name, InProcessEmulators(server, None, time.monotonic_ns))
    try:
        assert wait([near], 1.0), "their first heartbeats"
        near.receive()
        assert not wait([near], 1.0), "nothing can come before something is sent"
        near.send(make_sync(0, 0))
        assert wait([near], 1.0)
        assert len(decode_frames_of(near.receive(), Opcode.JOINT_STATE)) == JOINTS
    finally:
        near.close()


@pytest.mark.parametrize("address", ["nowhere", ":7450", "host:0", "host:99999", "host:x"])
def test_a_wrong_pose_address_is_refused(address: str):
    with raises_error(ConfigError, code="network/invalid-address"):
        PoseSender(address)

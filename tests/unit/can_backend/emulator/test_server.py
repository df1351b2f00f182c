"""The emulator server on a virtual bus of python-can, in real time and stepped, also after pauses of the server."""

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

ServedChain = tuple[VirtualWire, EmulatorServer, Callable[[float], list[CanFrame]]]
JOINTS = 4


@contextmanager
def serve_chain(module_chain: ModuleChain) -> Iterator[ServedChain]:
    """Serve a chain, and yield the wire of the host, the server, and a function that runs it until a time in s."""
    name = f"test-{uuid.uuid4().hex[:8]}"
    host_wire = VirtualWire(name)
    server_wire = VirtualWire(name)
    server = EmulatorServer([server_wire], module_chain)
    now_s = 0.0

    def run_until(end_s: float) -> list[CanFrame]:
        nonlocal now_s
        while True:
            pause_s = server.run_due(round(now_s * 1e9))
            if pause_s is None or now_s + pause_s > end_s:
                now_s = end_s
                server.run_due(round(now_s * 1e9))
                return host_wire.receive()
            now_s += pause_s

    try:
        yield host_wire, server, run_until
    finally:
        host_wire.close()
        server_wire.close()


def send_tick(host_wire: VirtualWire, tick: int) -> None:
    """Send the Sync and the setpoints of one control cycle."""
    host_wire.send(make_sync(tick, 0))
    for node in range(1, JOINTS + 1):
        host_wire.send(make_setpoint(tick, JointMode.POSITION, 0.2, node_id=node))


def test_server_modules_boot_follow_setpoints_and_stop_after_watchdog():
    module_chain = make_chain(is_stepped=False)
    with serve_chain(module_chain) as (host_wire, _, run_until):
        assert run_until(0.09) == []
        assert len(decode_frames_of(run_until(0.11), Opcode.HEARTBEAT)) == JOINTS
        host_wire.send(make_command(CommandAction.ARM))
        frames = []
        for tick in range(50):
            send_tick(host_wire, tick)
            frames += run_until(0.11 + 0.01 * (tick + 1))
        states = decode_frames_of(frames, Opcode.JOINT_STATE, 1)
        assert [state["count"] for state in states] == [tick % 16 for tick in range(50)]
        assert states[-1]["angle"] == pytest.approx(0.2, abs=0.01)
        run_until(0.69)
        assert [slot.module.state for slot in module_chain.slots] == [ModuleState.ARMED] * JOINTS
        run_until(0.705)
        assert [slot.module.state for slot in module_chain.slots] == [ModuleState.FAULT] * JOINTS


def test_server_pause_does_not_look_like_a_host_pause():
    module_chain = make_chain(is_stepped=False)
    with serve_chain(module_chain) as (host_wire, server, run_until):
        run_until(0.11)
        host_wire.send(make_command(CommandAction.ARM))
        for tick in range(5):
            send_tick(host_wire, tick)
            run_until(0.11 + 0.01 * (tick + 1))
        for tick in range(5, 20):  # the host continues while the server pauses for 150 ms
            send_tick(host_wire, tick)
        server.run_due(round(0.31e9))
        assert [slot.module.state for slot in module_chain.slots] == [ModuleState.ARMED] * JOINTS


def test_server_stepped_emulators_run_while_the_host_waits():
    module_chain = make_chain()
    name = f"test-{uuid.uuid4().hex[:8]}"
    server_wire = VirtualWire(name)
    server = EmulatorServer([server_wire], module_chain)
    host_wire = VirtualWire(name, InProcessEmulators(server, None, time.monotonic_ns))
    try:
        assert wait([host_wire], 1.0), "the modules send their first heartbeats"
        host_wire.receive()
        assert not wait([host_wire], 1.0), "stepped modules send nothing before the next Sync"
        host_wire.send(make_sync(0, 0))
        assert wait([host_wire], 1.0)
        assert len(decode_frames_of(host_wire.receive(), Opcode.JOINT_STATE)) == JOINTS
    finally:
        host_wire.close()


@pytest.mark.parametrize("address", ["nowhere", ":7450", "host:0", "host:99999", "host:x"])
def test_pose_sender_with_invalid_address_is_refused(address: str):
    with raises_error(ConfigError, code="network/invalid-address"):
        PoseSender(address)

"""The complete driver serves two buses, and a failure of one bus does not block the other one."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.driver import modules
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.server import EmulatorServer, InProcessEmulators
from snakesim_can_backend.protocol.commands import make_query
from snakesim_can_backend.protocol.definitions import (
    CanFrame,
    CommandAction,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.scenario import RunConfig
from snakesim_testing.can.driver_loop import DriverLoop, make_can_config
from snakesim_testing.can.recording_bus import (
    WIRES,
    RecordingWire,
    describe_host_frames,
    is_action,
    is_setpoint,
    run_in_lifecycle_state,
)
from snakesim_testing.messages import raises_error

# --- several buses -----------------------------------------------------------------------------------------------


class FakeEmulatorProcess:
    """Replaces the child process with the emulators, which run in this process."""

    started: list[tuple[Any, ...]] = []
    stopped = 0
    ended: str | None = None

    def __init__(
        self, run: RunConfig, settings: CanSettings, pose: str | None, *, is_stepped: bool
    ) -> None:
        self.started.append((settings.channels, pose, is_stepped))

    def describe_exit(self) -> str | None:
        return self.ended

    def stop(self) -> None:
        type(self).stopped += 1


@pytest.fixture
def two_buses(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[list[int]], DriverLoop]]:
    """Provide a function that opens a driver with these joint counts, on buses with three modules and one."""
    run = make_can_config(robot__sensors__pose__rate_hz=100.0)
    channels = ["bus_a", "bus_b"]
    emulator_settings = CanSettings(
        channels=channels, joints_per_channel=[3, 1], emulators="process", physics_model="inertia"
    )
    chain = ModuleChain(
        run, emulator_settings, InertiaModel(run, InertiaSettings()), is_stepped=True
    )
    emulators = InProcessEmulators(
        EmulatorServer([VirtualWire(name) for name in channels], chain), None, time.monotonic_ns
    )
    monkeypatch.setattr(
        "snakesim_can_backend.bus.adapter.validate_interface", lambda _channel: None
    )
    monkeypatch.setattr(modules, "open_wire", lambda name, bit_rate: RecordingWire(name, emulators))
    monkeypatch.setattr(modules, "EmulatorProcess", FakeEmulatorProcess)
    drivers: list[CanBackend] = []

    def open_driver(joints: list[int], **settings: Any) -> DriverLoop:
        driver_settings = CanSettings(
            channels=channels, joints_per_channel=joints, emulators="process", **settings
        )
        drivers.append(CanBackend(run, driver_settings))
        return DriverLoop(drivers[-1], run)

    yield open_driver
    for driver in drivers:
        driver.close()
    emulators.close()


def test_two_buses_each_carry_frames_of_their_modules(two_buses: Callable[..., DriverLoop]) -> None:
    FakeEmulatorProcess.started.clear()
    run = two_buses([3, 1])
    ((channels, pose, stepped),) = FakeEmulatorProcess.started
    assert channels == ["bus_a", "bus_b"]
    assert pose.startswith("127.0.0.1:")
    assert stepped
    run.arm()
    run.run(30, run.wave_joints)
    assert run.faults == []
    a, b = WIRES
    for wire, nodes in ((a, {1, 2, 3}), (b, {4})):
        assert {parse_node(frame.id) for frame in wire.sent} == {0, *nodes}
        assert {parse_node(frame.id) for frame in wire.sent if is_setpoint(frame)} == nodes
    syncs_a, syncs_b = (
        [frame.data for frame in wire.sent if parse_opcode(frame.id) == Opcode.SYNC]
        for wire in WIRES
    )
    assert syncs_a == syncs_b, "the modules do not measure at the same time"
    b.should_refuse = is_setpoint
    run.run(7, run.wave_joints)
    assert [fault.cause[:6] for fault in run.faults if fault.what == "bus_stuck"] == ["bus_b:"]
    stop_count = FakeEmulatorProcess.stopped
    run.backend.close()
    assert [describe_host_frames(wire.sent)[-1] for wire in WIRES] == ["disarm", "disarm"]
    assert FakeEmulatorProcess.stopped == stop_count + 1
    assert [wire.close_count for wire in WIRES] == [1, 1]


def test_two_buses_in_lockstep_have_no_frames_left_in_flight(
    two_buses: Callable[..., DriverLoop],
) -> None:
    run = two_buses([3, 1])
    run.run(2)
    for wire in WIRES:
        wire.sent.clear()
    run.run(20)
    for wire, node in zip(WIRES, (1, 4), strict=True):
        syncs_and_queries = [
            parse_opcode(frame.id)
            for frame in wire.sent
            if frame == make_query(node) or parse_opcode(frame.id) == Opcode.SYNC
        ]
        assert syncs_and_queries == [Opcode.SYNC, Opcode.PARAMETER_REQUEST] * 20
    assert run.backend.modules.module_reports.answers_missing == 0
    run.backend.close()


def test_two_buses_module_on_wrong_bus_is_detected_before_enabling(
    two_buses: Callable[..., DriverLoop],
) -> None:
    with raises_error(BackendError, code="drive/not-complete", field="joint_3"):
        two_buses([2, 2], bring_up_limit_s=0.3)
    assert [wire.close_count for wire in WIRES] == [1, 1]
    # The driver sends no command, because the modules may belong to another robot.
    assert not any(is_action(frame, CommandAction.DISARM) for wire in WIRES for frame in wire.sent)


def test_two_buses_driver_ends_if_its_emulators_died(
    two_buses: Callable[..., DriverLoop], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = two_buses([3, 1])
    run.run(1)
    monkeypatch.setattr(FakeEmulatorProcess, "ended", "they died")
    with raises_error(BackendError, code="backend/failed"):
        run.run(1)


def test_two_buses_failure_of_one_does_not_block_the_other(
    two_buses: Callable[..., DriverLoop],
) -> None:
    run = two_buses([3, 1])
    run.arm()

    def raise_error_for_emergency(frame: CanFrame) -> bool:
        if frame.id == 0:
            raise BackendError("the bus is broken")
        return False

    WIRES[0].should_refuse = raise_error_for_emergency
    with raises_error(BackendError, code="backend/failed"):
        run_in_lifecycle_state(run, "estop")
    assert describe_host_frames(WIRES[1].sent)[-1] == "emergency"

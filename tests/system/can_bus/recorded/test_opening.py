"""The whole driver on virtual buses with emulated joint modules: opening it, and a period."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from snakesim_can_backend.bus.bus import VirtualPeer
from snakesim_can_backend.driver import modules
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.driver.modules import compute_response_timeout_s
from snakesim_can_backend.emulator.firmware import ModuleFirmware
from snakesim_can_backend.emulator.server import InProcessEmulators, make_in_process_emulators
from snakesim_can_backend.protocol.commands import make_command, make_emergency
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    CommandAction,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
    Opcode,
    parse_node,
    parse_opcode,
)
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.scenario import load_scenario as load_scenario
from snakesim_hal.model.scenario import parse_set_option
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.driver_loop import JOINT_COUNT, make_can_config, open_driver_loop
from snakesim_testing.can.frames import decode_signals
from snakesim_testing.can.recording_bus import (
    DISARMED,
    EMERGENCY,
    WIRES,
    RecordingWire,
    describe_host_frames,
    is_action,
    is_setpoint,
    run_in_lifecycle_state,
)
from snakesim_testing.messages import raises_error

# --- opening -----------------------------------------------------------------------------------------------


def test_bring_up_enables_nothing() -> None:
    with open_driver_loop() as run:
        sent = WIRES[0].sent
        assert {parse_opcode(frame.id) for frame in sent} == {
            Opcode.COMMAND,
            Opcode.PARAMETER_REQUEST,
            Opcode.SYNC,
        }
        assert all(
            is_action(f, CommandAction.IDENTIFY, CommandAction.DISARM)
            for f in sent
            if parse_opcode(f.id) == Opcode.COMMAND
        )
        disarm = next(i for i, frame in enumerate(sent) if is_action(frame, CommandAction.DISARM))
        written = next(
            i for i, frame in enumerate(sent) if parse_opcode(frame.id) == Opcode.PARAMETER_REQUEST
        )
        assert disarm < written
        assert parse_node(sent[disarm].id) == BROADCAST
        assert run.states() == [DISARMED] * JOINT_COUNT
        assert not any(is_setpoint(frame) for frame in run_in_lifecycle_state(run, "disarmed", 30))
        assert run.faults == []
        assert run.true_speed_rad_s == [0.0] * 30


def test_opening_silent_module_is_reported_and_everything_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Deaf(RecordingWire):
        def __init__(self, channel: str, peer: VirtualPeer | None = None) -> None:
            super().__init__(channel, peer)
            self.should_ignore = lambda frame: (
                parse_opcode(frame.id) == Opcode.JOINT_STATE and parse_node(frame.id) == 2
            )

    monkeypatch.setattr(modules, "VirtualWire", Deaf)
    with raises_error(BackendError, code="drive/silent", field="joint_2"), open_driver_loop():
        pass
    (wire,) = WIRES
    assert wire.close_count == 1
    assert describe_host_frames(wire.sent)[-1] == "disarm"
    assert not any(map(is_setpoint, wire.sent))


def found_as(
    monkeypatch: pytest.MonkeyPatch, node: int, change: Callable[[ModuleFirmware], None]
) -> None:
    """When a driver opens its bus, one of the emulators is not as new."""

    def emulators(*given: Any, **more: Any) -> InProcessEmulators:
        end = make_in_process_emulators(*given, **more)
        change(end.server.chain.slots[node - 1].module)
        return end

    monkeypatch.setattr(modules, "start_in_process_emulators", emulators)


def left_behind(module: ModuleFirmware, kind: str) -> None:
    """What a module is like whose driver was killed, or worse."""
    if kind == "emergency":
        module.receive(make_emergency(), 0.0)
        return
    module.receive(make_command(CommandAction.ARM), 0.0)
    module._fail(ModuleFault.STREAM if kind == "stream" else ModuleFault.WATCHDOG, 0.0)
    if kind == "leak":  # after the watchdog had stopped it, water came, and went
        module.health.leak = True
        module.poll(0.0)
        module.health.leak = False
        assert module.last_stop == LastStop.WATCHDOG


@pytest.mark.parametrize(
    ("kind", "state"),
    [
        ("watchdog", DISARMED),
        ("stream", DISARMED),
        ("leak", ModuleState.FAULT),
        ("emergency", EMERGENCY),
    ],
)
def test_what_a_killed_driver_left_is_cleared_and_nothing_else(
    kind: str, state: ModuleState, monkeypatch: pytest.MonkeyPatch
) -> None:
    found_as(monkeypatch, 2, lambda module: left_behind(module, kind))
    with open_driver_loop() as run:
        run_in_lifecycle_state(run, "disarmed", 2)
        assert run.states() == [DISARMED, state, DISARMED, DISARMED]
        assert describe_host_frames(WIRES[0].sent).count("clear 2") == (state == DISARMED)
        found = [
            fault
            for _ in range(3)
            for fault in (run_in_lifecycle_state(run, "disarmed"), *run.faults)[1:]
        ]
        assert {fault.joint for fault in found} == (set() if state == DISARMED else {"joint_2"})


def test_a_module_that_is_too_weak_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    weak = {ModuleParameter.RATED_TORQUE: 1.0}
    found_as(monkeypatch, 3, lambda module: module.parameters.values.update(weak))
    with (
        raises_error(BackendError, code="drive/unsupported-setting", field="joint_3"),
        open_driver_loop(),
    ):
        pass


def test_paces_and_what_is_checked_before_anything_is_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert CanBackend.check(make_can_config(), CanSettings()) == ("lockstep", "realtime")
    with raises_error(ConfigError, code="bus/not-available", field="nocan7"):
        CanBackend.check(make_can_config(), CanSettings(channels=["nocan7"]))
    asked: list[str] = []
    monkeypatch.setattr("snakesim_can_backend.bus.adapter.validate_interface", asked.append)
    assert CanBackend.check(make_can_config(), CanSettings(channels=["can0", "can1"])) == (
        "realtime",
    )
    assert CanBackend.check(
        make_can_config(), CanSettings(channels=["vcan0"], emulators="process")
    ) == (
        "lockstep",
        "realtime",
    )
    assert asked == ["can0", "can1", "vcan0"]
    with raises_error(ConfigError, code="bus/not-virtual"):
        CanBackend.check(make_can_config(), CanSettings(emulators="none"))
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        CanBackend.check(make_can_config(robot__safety__action="hold"), CanSettings())
    assert WIRES == []


def test_opening_describes_joints_with_serials_and_firmware() -> None:
    with open_driver_loop() as run:
        joints = run.backend.describe().joints
        assert len({joint.serial for joint in joints}) == 4
        assert all(len(joint.serial) == 8 for joint in joints)
        assert [joint.firmware for joint in joints] == ["1.0"] * 4


def test_opening_waits_for_answers_as_long_as_fullest_bus() -> None:
    triplet = load_scenario("triplet", [parse_set_option("clock_mode=realtime")]).config
    assert compute_response_timeout_s(triplet, CanSettings()) == pytest.approx(
        1.25 * 27 * 135e-6 + 0.002
    )
    two = CanSettings(channels=["can0", "can1"])
    assert compute_response_timeout_s(triplet, two) == pytest.approx(1.25 * 15 * 135e-6 + 0.002)


# --- a period ----------------------------------------------------------------------------------------------


def test_opened_command_acts_one_period_after_its_state() -> None:
    change_at = 15
    speeds = []
    for torque_nm in (0.0, 1.0):
        with open_driver_loop() as run:
            run.setpoints = SafeSetpoints(
                [JointMode.TORQUE] * JOINT_COUNT, [0.0] * JOINT_COUNT, [4.0] * JOINT_COUNT
            )
            run.arm()

            def wish(tick: int, torque_nm: float = torque_nm) -> SafeSetpoints:
                return SafeSetpoints(
                    [JointMode.TORQUE] * JOINT_COUNT,
                    [torque_nm * (tick == change_at)] * JOINT_COUNT,
                    [4.0] * JOINT_COUNT,
                )

            run.run(change_at + 5 - run.tick, wish)
            speeds.append(np.array([samples.joints.velocity_rad_s for samples in run.samples]))
    moved = (np.abs(speeds[1] - speeds[0]) > 1e-9).any(axis=1)
    assert not moved[: change_at + 2].any(), "it waits for the next Sync"
    assert moved[change_at + 2 :].all(), "and acts from then on"


def test_opened_period_has_one_sync_and_one_setpoint_per_module() -> None:
    with open_driver_loop() as run:
        run.arm()
        for _ in range(20):
            sent = run_in_lifecycle_state(run, "armed")
            assert [parse_opcode(frame.id) for frame in sent] == [
                Opcode.SYNC,
                *[Opcode.SET_POINT] * JOINT_COUNT,
            ]
            assert [parse_node(frame.id) for frame in sent[1:]] == [1, 2, 3, 4]
        counts = [
            decode_signals(f)["count"] for f in WIRES[0].sent if parse_opcode(f.id) == Opcode.SYNC
        ]
        assert counts == [i % 256 for i in range(len(counts))]
        times = [
            decode_signals(f)["time"] for f in WIRES[0].sent if parse_opcode(f.id) == Opcode.SYNC
        ]
        assert np.diff(times[-20:]).tolist() == [10_000] * 19

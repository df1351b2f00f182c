"""The complete driver opens virtual buses with emulated joint modules, and sends the frames of a period."""

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

# --- opening -----------------------------------------------------------------------------------------------------


def test_opening_disarms_modules_first_and_enables_none() -> None:
    with open_driver_loop() as run:
        sent = WIRES[0].sent
        opcodes = [parse_opcode(frame.id) for frame in sent]
        assert set(opcodes) == {Opcode.COMMAND, Opcode.PARAMETER_REQUEST, Opcode.SYNC}
        for frame, opcode in zip(sent, opcodes, strict=True):
            if opcode == Opcode.COMMAND:
                assert is_action(frame, CommandAction.IDENTIFY, CommandAction.DISARM)
        are_disarm = [is_action(frame, CommandAction.DISARM) for frame in sent]
        first_disarm = are_disarm.index(True)
        assert first_disarm < opcodes.index(Opcode.PARAMETER_REQUEST)
        assert parse_node(sent[first_disarm].id) == BROADCAST
        assert run.states() == [DISARMED] * JOINT_COUNT
        assert not any(is_setpoint(frame) for frame in run_in_lifecycle_state(run, "disarmed", 30))
        assert run.faults == []
        assert run.true_speed_rad_s == [0.0] * 30


def test_opening_silent_module_is_reported_and_everything_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class WireWithSilentJoint2(RecordingWire):
        def __init__(self, channel: str, peer: VirtualPeer | None = None) -> None:
            super().__init__(channel, peer)
            self.should_ignore = lambda frame: (
                parse_opcode(frame.id) == Opcode.JOINT_STATE and parse_node(frame.id) == 2
            )

    monkeypatch.setattr(modules, "VirtualWire", WireWithSilentJoint2)
    with raises_error(BackendError, code="drive/silent", field="joint_2"), open_driver_loop():
        pass
    (wire,) = WIRES
    assert wire.close_count == 1
    assert describe_host_frames(wire.sent)[-1] == "disarm"
    assert not any(map(is_setpoint, wire.sent))


def change_emulated_module(
    monkeypatch: pytest.MonkeyPatch, node: int, change: Callable[[ModuleFirmware], None]
) -> None:
    """Change one of the emulated modules before the driver opens its bus."""

    def start_changed_emulators(*arguments: Any, **options: Any) -> InProcessEmulators:
        emulators = make_in_process_emulators(*arguments, **options)
        change(emulators.server.chain.slots[node - 1].module)
        return emulators

    monkeypatch.setattr(modules, "start_in_process_emulators", start_changed_emulators)


def set_state_after_killed_driver(module: ModuleFirmware, kind: str) -> None:
    """Bring a module into the state in which a killed driver, or an additional fault, leaves it."""
    if kind == "emergency":
        module.receive(make_emergency(), 0.0)
        return
    module.receive(make_command(CommandAction.ARM), 0.0)
    module._fail(ModuleFault.STREAM if kind == "stream" else ModuleFault.WATCHDOG, 0.0)
    if kind == "leak":  # a leak after the stop by the watchdog, which has ended
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
def test_opening_resets_only_faults_of_a_killed_driver(
    kind: str, state: ModuleState, monkeypatch: pytest.MonkeyPatch
) -> None:
    change_emulated_module(
        monkeypatch, 2, lambda module: set_state_after_killed_driver(module, kind)
    )
    with open_driver_loop() as run:
        run_in_lifecycle_state(run, "disarmed", 2)
        assert run.states() == [DISARMED, state, DISARMED, DISARMED]
        assert describe_host_frames(WIRES[0].sent).count("clear 2") == (state == DISARMED)
        faulty_joints: set[str | None] = set()
        for _ in range(3):
            run_in_lifecycle_state(run, "disarmed")
            faulty_joints.update(fault.joint for fault in run.faults)
        assert faulty_joints == (set() if state == DISARMED else {"joint_2"})


def test_opening_refuses_module_with_too_little_torque(monkeypatch: pytest.MonkeyPatch) -> None:
    weak_parameters = {ModuleParameter.RATED_TORQUE: 1.0}
    change_emulated_module(
        monkeypatch, 3, lambda module: module.parameters.values.update(weak_parameters)
    )
    with (
        raises_error(BackendError, code="drive/unsupported-setting", field="joint_3"),
        open_driver_loop(),
    ):
        pass


def test_check_returns_clock_modes_and_validates_settings_before_opening(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert CanBackend.check(make_can_config(), CanSettings()) == ("lockstep", "realtime")
    with raises_error(ConfigError, code="bus/not-available", field="nocan7"):
        CanBackend.check(make_can_config(), CanSettings(channels=["nocan7"]))
    validated: list[str] = []
    monkeypatch.setattr("snakesim_can_backend.bus.adapter.validate_interface", validated.append)
    assert CanBackend.check(make_can_config(), CanSettings(channels=["can0", "can1"])) == (
        "realtime",
    )
    assert CanBackend.check(
        make_can_config(), CanSettings(channels=["vcan0"], emulators="process")
    ) == (
        "lockstep",
        "realtime",
    )
    assert validated == ["can0", "can1", "vcan0"]
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


# --- a period ----------------------------------------------------------------------------------------------------


def test_opened_command_acts_one_period_after_its_state() -> None:
    change_tick = 15
    speeds_rad_s = []
    for torque_nm in (0.0, 1.0):
        with open_driver_loop() as run:
            run.setpoints = SafeSetpoints(
                [JointMode.TORQUE] * JOINT_COUNT, [0.0] * JOINT_COUNT, [4.0] * JOINT_COUNT
            )
            run.arm()

            def set_torque_at_change(tick: int, torque_nm: float = torque_nm) -> SafeSetpoints:
                return SafeSetpoints(
                    [JointMode.TORQUE] * JOINT_COUNT,
                    [torque_nm * (tick == change_tick)] * JOINT_COUNT,
                    [4.0] * JOINT_COUNT,
                )

            run.run(change_tick + 5 - run.tick, set_torque_at_change)
            speeds_rad_s.append(
                np.array([samples.joints.velocity_rad_s for samples in run.samples])
            )
    moved = (np.abs(speeds_rad_s[1] - speeds_rad_s[0]) > 1e-9).any(axis=1)
    # The command waits for the next Sync, and acts from then on.
    assert not moved[: change_tick + 2].any()
    assert moved[change_tick + 2 :].all()


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
        syncs = [
            decode_signals(frame)
            for frame in WIRES[0].sent
            if parse_opcode(frame.id) == Opcode.SYNC
        ]
        assert [sync["count"] for sync in syncs] == [i % 256 for i in range(len(syncs))]
        times_us = [sync["time"] for sync in syncs]
        assert np.diff(times_us[-20:]).tolist() == [10_000] * 19

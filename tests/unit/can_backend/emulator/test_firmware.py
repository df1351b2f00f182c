"""The rules of the firmware of one joint module, and properties that hold for any frames of a host."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_can_backend.emulator.firmware import ModuleFirmware
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command, make_emergency, make_sync
from snakesim_can_backend.protocol.definitions import (
    BROADCAST,
    CommandAction,
    LastStop,
    ModuleFault,
    ModuleParameter,
    ModuleState,
    Opcode,
)
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.can.frames import corrupt_checksum
from snakesim_testing.can.module_rig import (
    BOOTED_AT_US,
    NODE,
    RESTING_READINGS,
    US_PER_MS,
    arm_module,
    boot_module,
    decode_frames_of,
    make_module,
    make_parameter_request,
    make_setpoint,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count

ARM_COMMAND_WITHOUT_KEY = load_layouts()[Opcode.COMMAND].encode(BROADCAST, action=CommandAction.ARM)


def apply_setpoint(
    module: ModuleFirmware, count: int, now_us: float, **setpoint_fields: Any
) -> None:
    """Send a setpoint, and the Sync that applies it."""
    module.receive_setpoint(make_setpoint(count, **setpoint_fields), now_us)
    module.handle_sync(count, RESTING_READINGS)


def test_firmware_boots_silently_until_its_first_heartbeat():
    module = make_module()
    module.poll(0.0)
    module.receive(make_command(CommandAction.IDENTIFY), 50 * US_PER_MS)
    module.receive(make_command(CommandAction.ARM), 50 * US_PER_MS)
    module.handle_sync(1, RESTING_READINGS)
    module.poll(99 * US_PER_MS)
    assert module.frames == []
    assert module.state == ModuleState.BOOT
    module.poll(100 * US_PER_MS)
    [first_heartbeat] = decode_frames_of(module.frames, Opcode.HEARTBEAT)
    assert first_heartbeat["state"] == ModuleState.DISARMED
    assert first_heartbeat["uptime"] == pytest.approx(0.1)
    assert len(module.frames) == 1


def test_firmware_sends_ten_heartbeats_and_two_health_reports_per_second():
    module = boot_module()
    for ms in range(1, 1001):
        module.poll(BOOTED_AT_US + ms * US_PER_MS)
    assert len(decode_frames_of(module.frames, Opcode.HEARTBEAT)) == 10
    assert len(decode_frames_of(module.frames, Opcode.HEALTH)) == 2


def test_firmware_position_target_is_limited_to_the_angle_limit():
    module = arm_module(angle_limit=0.5)
    apply_setpoint(module, 0, BOOTED_AT_US, mode=JointMode.POSITION, target=-1.0)
    assert module.demand.target == -0.5


@pytest.mark.parametrize(
    ("cause", "fault"), [("leak", ModuleFault.LEAK), ("hot", ModuleFault.OVERHEAT)]
)
def test_firmware_fault_remains_until_cause_is_gone_and_cleared(cause: str, fault: ModuleFault):
    module = arm_module()
    module.health.leak = cause == "leak"
    module.health.winding_c = 110.0 if cause == "hot" else 20.0
    module.poll(BOOTED_AT_US + US_PER_MS)
    [heartbeat] = decode_frames_of(module.frames, Opcode.HEARTBEAT)
    assert heartbeat[f"fault_{fault.name.lower()}"] == 1
    assert heartbeat["last_stop"] == LastStop[fault.name]
    module.health.winding_c = 80.0 if cause == "hot" else 20.0
    module.receive(make_command(CommandAction.CLEAR), BOOTED_AT_US + 2 * US_PER_MS)
    assert module.state == ModuleState.FAULT
    module.health.leak = False
    module.health.winding_c = 79.0
    module.poll(BOOTED_AT_US + 3 * US_PER_MS)
    assert module.state == ModuleState.FAULT, "the fault is latched"
    module.receive(make_command(CommandAction.CLEAR), BOOTED_AT_US + 3 * US_PER_MS)
    assert module.state == ModuleState.DISARMED
    assert module.faults == 0


@pytest.mark.parametrize(
    ("first", "count", "is_accepted"),
    [
        (15, 0, True),  # the first counter is arbitrary, the next is one higher
        (0, 2, True),  # one or two lost setpoints are allowed
        (0, 3, True),
        (0, 4, False),  # too far ahead
        (0, 8, False),
        (0, 0, False),  # repeated
        (0, 15, False),  # earlier than the last one
    ],
)
def test_firmware_out_of_sequence_setpoint_is_dropped_and_counting_continues(
    first: int, count: int, is_accepted: bool
):
    module = arm_module()
    apply_setpoint(module, first, BOOTED_AT_US, target=1.0)
    apply_setpoint(module, count, BOOTED_AT_US, target=2.0)
    assert module.demand.target == pytest.approx(2.0 if is_accepted else 1.0)
    assert module.rejected_frame_count == (not is_accepted)
    apply_setpoint(module, count + 1, BOOTED_AT_US, target=3.0)
    assert module.demand.target == pytest.approx(3.0)
    assert module.state == ModuleState.ARMED


def test_firmware_setpoints_without_syncs_do_not_feed_the_watchdog():
    module = arm_module()
    apply_setpoint(module, 0, BOOTED_AT_US)
    for count in range(1, 30):
        module.receive_setpoint(
            make_setpoint(count, JointMode.PASSIVE), BOOTED_AT_US + count * 10 * US_PER_MS
        )
        module.poll(BOOTED_AT_US + count * 10 * US_PER_MS)
    assert module.state == ModuleState.FAULT
    assert module.last_stop == LastStop.WATCHDOG
    assert module.demand.mode == JointMode.PASSIVE


def test_firmware_setpoint_with_wrong_checksum_is_ignored():
    module = arm_module()
    apply_setpoint(module, 0, BOOTED_AT_US, target=1.0)
    module.receive_setpoint(
        corrupt_checksum(make_setpoint(1, target=2.0)), BOOTED_AT_US + 50 * US_PER_MS
    )
    module.handle_sync(1, RESTING_READINGS)
    assert module.demand.target == pytest.approx(1.0)
    assert module._watchdog_fed_us == BOOTED_AT_US
    assert module.rejected_frame_count == 1


def test_firmware_stopping_module_damps_until_at_rest():
    module = arm_module()
    apply_setpoint(module, 0, BOOTED_AT_US)
    module.health.speed_rad_s = 3.0
    module.receive(make_command(CommandAction.STOP), BOOTED_AT_US)
    assert module.state == ModuleState.STOPPING
    assert module.demand[:2] == (JointMode.VELOCITY, 0.0)
    assert decode_frames_of(module.frames, Opcode.HEARTBEAT)[-1]["mode"] == JointMode.VELOCITY
    module.poll(BOOTED_AT_US + 50 * US_PER_MS)
    assert module.state == ModuleState.STOPPING
    module.health.speed_rad_s = 0.04
    module.poll(BOOTED_AT_US + 51 * US_PER_MS)
    assert module.state == ModuleState.DISARMED
    assert module.demand.mode == JointMode.PASSIVE
    assert module.last_stop == LastStop.STOP


def test_firmware_stopping_ends_after_watchdog_time():
    module = arm_module(stop_mode=0, watchdog=0.05)
    module.health.speed_rad_s = 3.0
    module.receive(make_command(CommandAction.STOP), BOOTED_AT_US)
    assert module.demand.mode == JointMode.PASSIVE
    module.poll(BOOTED_AT_US + 50 * US_PER_MS)
    assert module.state == ModuleState.DISARMED


@pytest.mark.parametrize(
    "frame", [ARM_COMMAND_WITHOUT_KEY, corrupt_checksum(make_command(CommandAction.ARM))]
)
def test_firmware_command_without_key_or_checksum_is_ignored(frame):
    module = boot_module()
    module.receive(frame, BOOTED_AT_US)
    assert module.state == ModuleState.DISARMED


def test_firmware_reboot_loses_unsaved_parameters():
    module = arm_module()
    module.receive(make_command(CommandAction.DISARM), BOOTED_AT_US)
    module.receive(make_parameter_request(ModuleParameter.STIFFNESS, 12.0), BOOTED_AT_US)
    module.receive(make_parameter_request(ModuleParameter.DAMPING, 2.0), BOOTED_AT_US)
    module.receive(make_parameter_request(ModuleParameter.DAMPING, operation=2), BOOTED_AT_US)
    module.receive(make_command(CommandAction.REBOOT, NODE), BOOTED_AT_US)
    assert module.state == ModuleState.BOOT
    module.frames.clear()
    module.poll(BOOTED_AT_US + 100 * US_PER_MS)
    [heartbeat] = decode_frames_of(module.frames, Opcode.HEARTBEAT)
    assert heartbeat["uptime"] == pytest.approx(0.1)
    values = module.parameters.values
    assert values[ModuleParameter.STIFFNESS] == 0.0
    assert values[ModuleParameter.DAMPING] == 2.0


def test_firmware_uptime_saturates_at_end_of_range() -> None:
    """Check that the uptime does not wrap around, because an uptime of 0 would look like a restart."""
    module = boot_module()
    module._boot_start_us = -(2**32 - 50) * US_PER_MS
    heartbeats = [
        load_layouts()[Opcode.HEARTBEAT].decode(module.make_heartbeat(at_us).data)
        for at_us in (0.0, 100 * US_PER_MS, 500 * US_PER_MS)
    ]
    assert [heartbeat["uptime"] for heartbeat in heartbeats] == pytest.approx(
        [4294967.246, 4294967.295, 4294967.295], abs=1e-6
    )


def test_firmware_answers_every_sync_with_its_count():
    module = boot_module(contact_every=4, imu_every=5, tail=1)
    for count in range(20):
        module.handle_sync(count, RESTING_READINGS)
    states = decode_frames_of(module.frames, Opcode.JOINT_STATE)
    assert [state["count"] for state in states] == [count % 16 for count in range(20)]
    assert [report["count"] for report in decode_frames_of(module.frames, Opcode.CONTACT)] == [
        0,
        4,
        8,
        12,
        0,
    ]
    assert len(decode_frames_of(module.frames, Opcode.TAIL_CONTACT)) == 5


def test_firmware_hanging_module_repeats_state_until_hardware_watchdog():
    module = arm_module()
    apply_setpoint(module, 3, BOOTED_AT_US)
    module.is_hanging = True
    module.frames.clear()
    module.handle_sync(4, RESTING_READINGS)
    [state] = decode_frames_of(module.frames, Opcode.JOINT_STATE)
    assert state["count"] == 3
    assert module.demand.mode == JointMode.TORQUE
    for elapsed_ms in range(1, 300):
        module.poll(BOOTED_AT_US + elapsed_ms * US_PER_MS)
        assert (module.demand.mode == JointMode.PASSIVE) == (elapsed_ms >= 100)
    assert not decode_frames_of(module.frames, Opcode.HEARTBEAT)
    module.is_hanging = False
    module.poll(BOOTED_AT_US + 301 * US_PER_MS)
    assert module.last_stop == LastStop.WATCHDOG


# --- arbitrary frames of a host ----------------------------------------------------------------------------

ANY_FRAMES = st.one_of(
    st.sampled_from(list(CommandAction)).map(make_command),
    st.just(make_emergency()),
    st.builds(make_setpoint, st.integers(0, 15), st.sampled_from(list(JointMode))),
    st.builds(corrupt_checksum, st.builds(make_setpoint, st.integers(0, 15))),
    st.builds(corrupt_checksum, st.just(make_command(CommandAction.ARM))),
    st.builds(
        make_parameter_request, st.integers(0, 20), st.floats(-1, 40, width=32), st.integers(0, 4)
    ),
    st.builds(make_sync, st.integers(0, 255), st.just(0)),
)
PAUSES = st.sampled_from([0.0, 1.0 * US_PER_MS, 20 * US_PER_MS, 120 * US_PER_MS])


def deliver_frame(module: ModuleFirmware, frame, now_us: float) -> None:
    """Deliver a frame to the handler of its opcode."""
    opcode = frame.id >> 6
    if opcode == Opcode.SYNC:
        module.handle_sync(frame.data[0], RESTING_READINGS)
    elif opcode == Opcode.SET_POINT:
        module.receive_setpoint(frame, now_us)
    else:
        module.receive(frame, now_us)


@settings(max_examples=choose_trial_count(100), deadline=None)
@given(st.lists(st.tuples(ANY_FRAMES, PAUSES, st.booleans()), max_size=60))
def test_firmware_drives_only_when_armed_with_valid_setpoints(events):
    module = boot_module()
    now_us = BOOTED_AT_US
    module.health.speed_rad_s = 1.0
    for frame, pause_us, leak in events:
        now_us += pause_us
        module.health.leak = leak and pause_us > 0
        module.poll(now_us)
        fed_before_us = module._watchdog_fed_us
        state_before = module.state
        rejected_before = module.rejected_frame_count
        deliver_frame(module, frame, now_us)
        if (
            module._watchdog_fed_us != fed_before_us
            and state_before == ModuleState.ARMED
            and module.state == ModuleState.ARMED
        ):
            assert frame.id >> 6 == Opcode.SET_POINT
            assert module.rejected_frame_count == rejected_before
        if module.state not in (ModuleState.ARMED, ModuleState.STOPPING):
            assert module.demand.mode == JointMode.PASSIVE


@pytest.mark.parametrize(("voltage_v", "faults"), [(18.0, 0), (17.99, 1 << ModuleFault.VOLTAGE)])
def test_firmware_supply_below_18_v_is_a_fault(voltage_v: float, faults: int) -> None:
    module = arm_module()
    module.health.voltage_v = voltage_v
    module.poll(BOOTED_AT_US + 10 * US_PER_MS)
    assert module.faults == faults
    assert module.state == (ModuleState.FAULT if faults else ModuleState.ARMED)

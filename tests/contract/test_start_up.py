"""A driver type with homing, brakes, limit switches and safe torque off, with the real safety core."""

from collections.abc import Iterator

import pytest

from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.benches.homing_drives import HomingBackend, HomingEmulator
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.kit_drives import KitDrives
from snakesim_testing.contract.rig import BackendRig
from snakesim_testing.drivers.drive_rig import drives_of

PERIODS_PER_S = 50


def open_bench(*overrides: str) -> Bench:
    """Return a bench with drives that need homing, and scenario overrides."""
    return Bench("homing", HomingBackend, overrides=overrides, make_emulated_drives=KitDrives)


@pytest.fixture
def rig() -> Iterator[BackendRig]:
    bench = open_bench()
    yield bench.open_rig()
    bench.close()


def get_emulator(rig: BackendRig) -> HomingEmulator:
    return drives_of(rig.backend).emulator


def list_unmet_conditions(rig: BackendRig) -> str:
    """Return the conditions that prevent arming, as one text."""
    return "; ".join(rig.authority.list_unmet_conditions(rig.tick * rig.period_ns))


def test_drives_home_at_the_start_and_can_be_armed(rig: BackendRig) -> None:
    assert all(extras.is_homed for extras in get_emulator(rig).homing_states)
    assert rig.faults == []
    rig.arm_and_move_joint()


def test_drive_that_may_not_move_at_the_start_blocks_arming() -> None:
    bench = open_bench("backends.homing.home_at_start=false")
    rig = bench.open_rig()
    assert "joint_1 (drive 1): homing moves the joint" in list_unmet_conditions(rig)
    with pytest.raises(AssertionError, match=r"cannot be armed: .*homing moves the joint"):
        rig.arm()
    assert not any(extras.is_homed for extras in get_emulator(rig).homing_states)
    bench.close()


def test_restarted_drive_without_position_homes_after_reset(rig: BackendRig) -> None:
    rig.arm_and_move_joint()
    rig.backend.inject(parse_injection("reboot:joint_1@0"), begins=True)
    rig.wait_periods(PERIODS_PER_S)
    assert rig.authority.state == "fault"
    assert "position unknown" in list_unmet_conditions(rig)
    rig.wait_periods(PERIODS_PER_S)
    assert not get_emulator(rig).homing_states[0].is_homed, (
        "the drive must not home without the operator"
    )
    rig.reset()
    rig.wait_periods(5)
    assert "joint_1 (drive 1): homing, 0.1 of 2 s" in list_unmet_conditions(rig)
    rig.wait_periods(PERIODS_PER_S)
    assert "joint_1" not in list_unmet_conditions(rig)
    rig.arm_and_move_joint()


def test_homing_that_fails_names_step_and_reason(rig: BackendRig) -> None:
    emulator = get_emulator(rig)
    emulator.without_index.add(1)
    rig.backend.inject(parse_injection("reboot:joint_2@0"), begins=True)
    rig.wait_periods(2 * PERIODS_PER_S)
    rig.reset()
    rig.wait_periods(3 * PERIODS_PER_S)
    assert rig.authority.state == "fault"
    assert "joint_2 (drive 2): homing failed: no index found" in list_unmet_conditions(rig)
    assert "drive_not_ready" in {fault.what for fault in rig.faults}


def test_emergency_stop_ends_homing(rig: BackendRig) -> None:
    rig.backend.inject(parse_injection("reboot:joint_1@0"), begins=True)
    rig.wait_periods(PERIODS_PER_S)
    rig.reset()
    rig.wait_periods(5)
    assert get_emulator(rig).homing_states[0].homing_until_us is not None
    rig.trigger_estop()
    rig.wait_periods(3)
    assert get_emulator(rig).homing_states[0].homing_until_us is None
    assert "homing was aborted: emergency stop" in list_unmet_conditions(rig)
    rig.reset()
    rig.wait_periods(2 * PERIODS_PER_S)
    rig.arm_and_move_joint()


def test_brakes_close_before_torque_is_off(rig: BackendRig) -> None:
    emulator = get_emulator(rig)
    rig.arm_and_move_joint()
    assert all(extras.is_brake_open for extras in emulator.homing_states)
    emulator.dropped_drives.clear()
    rig.disarm()
    rig.wait_periods(PERIODS_PER_S // 2)
    assert not any(extras.is_brake_open for extras in emulator.homing_states)
    assert not any(KitDrives(rig.backend).list_enabled())
    assert emulator.dropped_drives == []


def test_safe_torque_off_needs_its_release_and_a_reset(rig: BackendRig) -> None:
    emulator = get_emulator(rig)
    rig.arm_and_move_joint()
    emulator.torque_off.add(2)
    rig.wait_periods(5)
    assert "safe_torque_off" in {fault.what for fault in rig.faults}
    assert rig.authority.state == "fault"
    rig.reset()
    rig.wait_periods(PERIODS_PER_S // 2)
    assert rig.authority.state == "fault", "a reset while the input is active has no effect"
    emulator.torque_off.clear()
    rig.wait_periods(PERIODS_PER_S // 2)
    assert rig.authority.state == "fault", "the release alone does not reset the fault"
    rig.reset()
    rig.wait_periods(PERIODS_PER_S // 2)
    rig.arm_and_move_joint()


def test_limit_switch_stops_and_allows_only_motion_away(rig: BackendRig) -> None:
    emulator = get_emulator(rig)
    rig.arm_and_move_joint()
    emulator.at_upper.add(0)
    rig.wait_periods(5)
    assert [(fault.what, fault.joint) for fault in rig.faults] == [("limit_switch", "joint_1")]
    rig.wait_periods(PERIODS_PER_S)
    rig.reset()
    rig.wait_periods(PERIODS_PER_S // 2)
    rig.arm()
    towards_switch = rig.command_joints({0: (JointMode.VELOCITY, 0.3)}, PERIODS_PER_S // 2)
    assert towards_switch.angle_rad[-1, 0] - towards_switch.angle_rad[0, 0] < 0.02
    away_from_switch = rig.command_joints({0: (JointMode.VELOCITY, -0.3)}, PERIODS_PER_S // 2)
    assert away_from_switch.angle_rad[-1, 0] - away_from_switch.angle_rad[0, 0] < -0.05

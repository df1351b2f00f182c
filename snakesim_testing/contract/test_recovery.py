"""Drives that restart, share an id or lose their bus: each stops the robot, and none is enabled again by itself.

How soon torque is off is measured by the drives' own log, not by what the driver reports.
"""

from collections.abc import Callable

import pytest

from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import EmulatedDrives
from snakesim_testing.contract.faults import inject_or_skip
from snakesim_testing.contract.rig import BackendRig, JointTargets
from snakesim_testing.contract.test_drives import assert_drives_stay_off

MOVE_JOINT_0: JointTargets = {0: (JointMode.VELOCITY, tolerances.MOTION_SPEED_RAD_S)}

# Injected faults, as KIND:TARGET@BEGIN-END with times in s of robot time; the tests begin and end them by themselves.
BUS_1_LOST = "cut:bus_1@0-9"
JOINT_2_DUPLICATED = "duplicate:joint_2@0-9"


@pytest.mark.parametrize(
    "stop", [BackendRig.disarm, BackendRig.trigger_estop], ids=["disarm", "estop"]
)
def test_torque_is_off_in_time_by_the_drives_own_log(
    rig: BackendRig, drives: EmulatedDrives, stop: Callable[[BackendRig], None]
) -> None:
    """If a moving robot is disarmed or stopped, every drive switches its torque off within a few periods."""
    rig.arm_and_move_joint()
    start_s = drives.read_time_s()
    stop(rig)
    rig.wait_periods(rig.count_periods(tolerances.SETTLING_TIME_S))
    assert_switched_off(rig, drives, start_s, tolerances.TORQUE_OFF_PERIODS * rig.period_ns * 1e-9)


def test_torque_is_off_after_watchdog_by_the_drives_own_log(
    rig: BackendRig, drives: EmulatedDrives
) -> None:
    """If the host does nothing while a joint moves, every drive switches its torque off in time, by its watchdog."""
    joints_without_watchdog = rig.joints_without_watchdog
    if joints_without_watchdog:
        pytest.skip(
            f"these joints have no watchdog, so they hold while the host is frozen: {joints_without_watchdog}"
        )
    rig.arm_and_move_joint()
    rig.must_reopen = True
    start_s = drives.read_time_s()
    rig.freeze_host(tolerances.FREEZE_DURATION_S, drives.freeze_driver)
    assert_switched_off(rig, drives, start_s, tolerances.MAX_WATCHDOG_OFF_S)


def test_a_drive_restarted_in_motion_stays_off_until_reset(
    rig: BackendRig, drives: EmulatedDrives
) -> None:
    """The drive of a moving joint restarts: a fault names the joint, and all drives are off until reset and arming."""
    rig.arm_and_move_joint()
    rig.must_reopen = True
    start_tick = rig.tick
    inject_or_skip(rig, "reboot:joint_1@0")
    rig.command_joints(MOVE_JOINT_0, rig.count_periods(tolerances.DRIVE_RESTART_TIME_S))
    assert_fault_names_joint(rig, start_tick, 0)
    assert_recovers_by_reset_alone(rig, drives)


def test_two_drives_with_one_id_stop_the_robot(rig: BackendRig, drives: EmulatedDrives) -> None:
    """A second drive with the id of a joint's drive is a fault, also after a reset, until the second drive is gone."""
    rig.arm_and_move_joint()
    rig.must_reopen = True
    start_tick = rig.tick
    inject_or_skip(rig, JOINT_2_DUPLICATED)
    rig.command_joints(MOVE_JOINT_0, rig.count_periods(tolerances.SETTLING_TIME_S))
    assert_fault_names_joint(rig, start_tick, 1)
    assert "duplicate_node" in {fault.what for fault in rig.record_since(start_tick).faults}, (
        rig.record_since(start_tick).faults
    )
    rig.reset()
    rig.wait_periods(rig.count_periods(tolerances.SETTLING_TIME_S))
    assert rig.authority.state == "fault", (
        "after a reset the robot may be armed, although the second drive still exists"
    )
    rig.backend.inject(parse_injection(JOINT_2_DUPLICATED), begins=False)  # ends the fault
    assert_recovers_by_reset_alone(rig, drives)


def test_a_bus_that_is_lost_and_restored_enables_no_drive(
    rig: BackendRig, drives: EmulatedDrives
) -> None:
    """If a bus loses all frames in motion, its drives are disabled, and stay disabled once frames pass again.

    Drives with a watchdog switch their torque off by themselves while the bus is lost. Drives that are described
    without a watchdog hold their joints until the bus works again, and are then switched off by the driver. In both
    cases the robot is at fault, and no drive is enabled again before a reset and an arming.
    """
    joints_without_watchdog = rig.joints_without_watchdog
    rig.arm_and_move_joint()
    rig.must_reopen = True
    start_tick = rig.tick
    start_s = drives.read_time_s()
    inject_or_skip(rig, BUS_1_LOST)
    rig.command_joints(MOVE_JOINT_0, rig.count_periods(tolerances.FREEZE_DURATION_S))
    assert rig.authority.state == "fault", "the bus is lost, and the robot continues"
    assert rig.record_since(start_tick).faults
    # In lockstep, some drives get their time over the bus. Their time does not pass while the bus is lost, so their
    # watchdogs cannot expire.
    has_drive_time_passed = drives.read_time_s() > start_s + tolerances.MAX_WATCHDOG_OFF_S
    if not joints_without_watchdog and has_drive_time_passed:
        assert_switched_off(
            rig,
            drives,
            start_s,
            tolerances.MAX_WATCHDOG_OFF_S + tolerances.TRANSPORT_PERIODS * rig.period_ns * 1e-9,
        )
    rig.backend.inject(parse_injection(BUS_1_LOST), begins=False)  # ends the fault
    if joints_without_watchdog:
        rig.wait_periods(tolerances.TRANSPORT_PERIODS)
    assert_recovers_by_reset_alone(rig, drives)


def assert_fault_names_joint(rig: BackendRig, since_tick: int, joint_index: int) -> None:
    """Fail if the robot is not at fault, or if no fault since a tick names the joint."""
    assert rig.authority.state == "fault", f"the robot continues in state {rig.authority.state}"
    faults = rig.record_since(since_tick).faults
    name = rig.robot.joints[joint_index].name
    assert name in {fault.joint for fault in faults}, (
        f"the backend reported no fault of {name}, but {faults}"
    )


def assert_recovers_by_reset_alone(rig: BackendRig, drives: EmulatedDrives) -> None:
    """Fail if a drive is enabled before reset and arming, or if the robot cannot be moved after them."""
    assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.SETTLING_TIME_S))
    rig.reset()
    assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.DRIVE_RESTART_TIME_S))
    # A fault that was detected again while its cause was still there.
    if rig.authority.state == "fault":
        rig.reset()
        assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.DRIVE_RESTART_TIME_S))
    rig.arm_and_move_joint()
    assert all(drives.list_enabled()), (
        f"not all drives are enabled after reset and arming: {drives.list_enabled()}"
    )


def assert_switched_off(
    rig: BackendRig, drives: EmulatedDrives, start_s: float, max_duration_s: float
) -> None:
    """Fail unless every drive's own log shows that its torque was switched off in time, and has been off since then.

    Args:
        rig: The open backend.
        drives: The emulated drives of the backend.
        start_s: Time of the stop, by the drives' own clock.
        max_duration_s: Maximum time from the stop until the torque is off.
    """
    assert not any(drives.list_enabled()), f"drives are still enabled: {drives.list_enabled()}"
    for i, joint in enumerate(rig.robot.joints):
        off_times_s = [
            entry.time_s
            for entry in drives.list_torque_switches()
            if entry.joint == i and not entry.is_on
        ]
        assert off_times_s and off_times_s[-1] >= start_s, (
            f"the log of {joint.name} does not show when its torque went off"
        )
        duration_s = off_times_s[-1] - start_s
        assert duration_s <= max_duration_s, (
            f"{joint.name} had torque for {duration_s:.3f} s; allowed are {max_duration_s:.3f} s"
        )

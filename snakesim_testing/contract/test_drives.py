"""Drives without their driver: what has stopped by itself stays off, and nothing brakes without end."""

from collections.abc import Callable

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import EmulatedDrives
from snakesim_testing.contract.rig import BackendRig


def do_nothing(_rig: BackendRig) -> None:
    """Do nothing: the host detects by itself that it was frozen."""


@pytest.mark.parametrize(
    "act_after_freeze",
    [do_nothing, BackendRig.disarm, BackendRig.trigger_estop],
    ids=["goes_on", "disarm", "estop"],
)
def test_drives_that_stop_during_host_freeze_stay_off_until_reset(
    rig: BackendRig, drives: EmulatedDrives, act_after_freeze: Callable[[BackendRig], None]
) -> None:
    """If the host does nothing for 1 s while a joint moves, every drive switches off by its own watchdog.

    Once the host resumes, the backend reports each of those stops as a fault of its joint, whatever the operator asks
    for first. No drive is enabled again before the fault is reset and the robot armed.
    """
    joints_without_watchdog = rig.joints_without_watchdog
    if joints_without_watchdog:
        pytest.skip(
            f"these joints have no watchdog, so they hold while the host is frozen: {joints_without_watchdog}"
        )
    rig.arm_and_move_joint()
    rig.must_reopen = True
    assert all(drives.list_enabled()), (
        f"the robot is armed, but not all drives are enabled: {drives.list_enabled()}"
    )
    start_tick = rig.tick
    rig.freeze_host(tolerances.FREEZE_DURATION_S, drives.freeze_driver)
    assert not any(drives.list_enabled()), (
        f"drives are enabled after {tolerances.FREEZE_DURATION_S} s without their driver: {drives.list_enabled()}"
    )
    act_after_freeze(rig)
    assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.SETTLING_TIME_S))
    record = rig.record_since(start_tick)
    reported_joints = {fault.joint for fault in record.faults if fault.cause}
    unreported_joints = [
        joint.name for joint in rig.robot.joints if joint.name not in reported_joints
    ]
    assert not unreported_joints, (
        f"the backend did not report the stop of {unreported_joints}; it reported {record.faults}"
    )
    assert rig.authority.state in ("fault", "estop"), rig.authority.state
    rig.reset()
    assert_drives_stay_off(rig, drives, tolerances.ARMING_PERIODS)
    reset_tick = rig.tick
    rig.arm_and_move_joint()
    assert all(drives.list_enabled()), (
        f"not all drives are enabled after reset and arming: {drives.list_enabled()}"
    )
    assert not rig.record_since(reset_tick).faults, rig.record_since(reset_tick).faults


def test_drives_without_watchdog_are_off_once_frozen_host_resumes(
    rig: BackendRig, drives: EmulatedDrives
) -> None:
    """Drives that are described without a watchdog hold while the host does nothing.

    Once it resumes, the backend switches each of them off at once, reports it as a fault of its joint, and enables none
    before the fault is reset and the robot armed.
    """
    joints_without_watchdog = rig.joints_without_watchdog
    if not joints_without_watchdog:
        pytest.skip("every joint is described with a watchdog")
    rig.arm_and_move_joint()
    rig.must_reopen = True
    start_tick = rig.tick
    rig.freeze_host(tolerances.FREEZE_DURATION_S, drives.freeze_driver)
    rig.wait_periods(tolerances.TRANSPORT_PERIODS)
    assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.SETTLING_TIME_S))
    record = rig.record_since(start_tick)
    reported_joints = {fault.joint for fault in record.faults if fault.cause}
    assert reported_joints >= {*joints_without_watchdog}, (
        f"the backend did not report all joints without a watchdog, but {record.faults}"
    )
    assert rig.authority.state in ("fault", "estop"), rig.authority.state
    rig.reset()
    assert_drives_stay_off(rig, drives, tolerances.ARMING_PERIODS)
    rig.arm_and_move_joint()
    assert all(drives.list_enabled()), (
        f"not all drives are enabled after reset and arming: {drives.list_enabled()}"
    )


def assert_drives_stay_off(rig: BackendRig, drives: EmulatedDrives, period_count: int) -> None:
    """Fail if a drive is enabled after any of some periods without a command."""
    for _ in range(period_count):
        rig.wait_periods()
        assert not any(drives.list_enabled()), (
            f"drives are enabled again in state {rig.authority.state}: {drives.list_enabled()}"
        )


def test_drives_brake_after_fault_and_are_off_after_watchdog(
    rig: BackendRig, drives: EmulatedDrives
) -> None:
    """After a fault, the drive of a moving joint brakes it, but not for longer than the time of its watchdog."""
    rig.arm_and_move_joint()
    rig.report_fault()
    rig.wait_periods()
    if rig.supports_mode(
        0, JointMode.VELOCITY
    ):  # otherwise the joint is led to rest by its position, which takes less than a period
        assert drives.list_enabled()[0], "the joint moves, and its drive does not brake"
    rig.wait_periods(rig.count_periods(tolerances.MAX_BRAKING_S) + tolerances.TRANSPORT_PERIODS)
    assert_drives_stay_off(rig, drives, rig.count_periods(tolerances.SETTLING_TIME_S))
    assert np.abs(rig.newest_joints.velocity_rad_s).max() < tolerances.STANDSTILL_RAD_S, (
        f"the joints still move: {rig.newest_joints.velocity_rad_s} rad/s"
    )

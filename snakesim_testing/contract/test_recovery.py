"""Drives that restart, share an id or lose their bus: each stops the robot, and none is enabled again by itself.

How soon torque is off is measured by the drives' own log, not by what the driver reports.
"""

from collections.abc import Callable

import pytest

from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import EmulatedDrives
from snakesim_testing.contract.faults import inject_or_skip
from snakesim_testing.contract.rig import JointTargets, Rig
from snakesim_testing.contract.test_drives import assert_drives_stay_off

GO: JointTargets = {0: (Mode.VELOCITY, t.CRUISE_RAD_S)}


@pytest.mark.parametrize("stop", [Rig.disarm, Rig.estop], ids=["disarm", "estop"])
def test_torque_is_off_in_time_by_the_drives_own_log(
    rig: Rig, drives: EmulatedDrives, stop: Callable[[Rig], None]
) -> None:
    """Disarmed or stopped in motion: every drive has switched its torque off a few periods later."""
    rig.cruise()
    began_s = drives.now_s()
    stop(rig)
    rig.idle(rig.count_periods(t.SETTLE_S))
    assert_switched_off(rig, drives, began_s, t.OFF_PERIODS * rig.period_ns * 1e-9)


def test_torque_is_off_after_watchdog_by_the_drives_own_log(rig: Rig, drives: EmulatedDrives) -> None:
    """A host that does nothing while a joint moves: every drive switches off by its own watchdog, in its time."""
    unguarded = rig.joints_without_watchdog
    if unguarded:
        pytest.skip(f"described without a watchdog, so they hold while the host does nothing: {unguarded}")
    rig.cruise()
    rig.spoiled = True
    began_s = drives.now_s()
    rig.freeze_host(t.FROZEN_S, drives.freeze_driver)
    assert_switched_off(rig, drives, began_s, t.WATCHDOG_OFF_S)


def test_a_drive_restarted_in_motion_stays_off_until_reset(rig: Rig, drives: EmulatedDrives) -> None:
    """The drive of a moving joint restarts: the fault names it, and all drives are off until reset and arming."""
    rig.cruise()
    rig.spoiled = True
    began = rig.tick
    inject_or_skip(rig, "reboot:joint_1@0")
    rig.drive(GO, rig.count_periods(t.RESTART_S))
    assert_fault_names_joint(rig, began, 0)
    assert_recovers_by_reset_alone(rig, drives)


def test_two_drives_with_one_id_stop_the_robot(rig: Rig, drives: EmulatedDrives) -> None:
    """A second drive with the id of a joint's drive is a fault, also after a reset, until it is gone."""
    rig.cruise()
    rig.spoiled = True
    began = rig.tick
    inject_or_skip(rig, "duplicate:joint_2@0-9")
    rig.drive(GO, rig.count_periods(t.SETTLE_S))
    assert_fault_names_joint(rig, began, 1)
    assert "duplicate_node" in {fault.what for fault in rig.record_since(began).faults}, rig.record_since(began).faults
    rig.reset()
    rig.idle(rig.count_periods(t.SETTLE_S))
    assert rig.authority.state == "fault", "reset while the second drive is still there, and the robot may be armed"
    rig.backend.inject(parse_injection("duplicate:joint_2@0-9"), begins=False)
    assert_recovers_by_reset_alone(rig, drives)


def test_a_bus_that_is_lost_and_restored_enables_no_drive(rig: Rig, drives: EmulatedDrives) -> None:
    """Nothing passes the bus for a while: its drives stop by their watchdogs, and stay off when it works again.

    Drives that are described without a watchdog hold meanwhile, and the driver switches them off when it works again.
    """
    unguarded = rig.joints_without_watchdog
    rig.cruise()
    rig.spoiled = True
    began = rig.tick
    began_s = drives.now_s()
    inject_or_skip(rig, "cut:bus_1@0-9")
    rig.drive(GO, rig.count_periods(t.FROZEN_S))
    assert rig.authority.state == "fault", "the bus is lost, and the robot continues"
    assert rig.record_since(began).faults
    if (
        not unguarded and drives.now_s() > began_s + t.WATCHDOG_OFF_S
    ):  # in lockstep the time of some drives comes by the bus
        assert_switched_off(rig, drives, began_s, t.WATCHDOG_OFF_S + t.TRANSPORT_PERIODS * rig.period_ns * 1e-9)
    rig.backend.inject(parse_injection("cut:bus_1@0-9"), begins=False)
    if unguarded:
        rig.idle(t.TRANSPORT_PERIODS)
    assert_recovers_by_reset_alone(rig, drives)


def assert_fault_names_joint(rig: Rig, since_tick: int, joint: int) -> None:
    """Fail if the robot continues, or no fault names the joint."""
    assert rig.authority.state == "fault", f"the robot continues: {rig.authority.state}"
    faults = rig.record_since(since_tick).faults
    name = rig.robot.joints[joint].name
    assert name in {fault.joint for fault in faults}, f"no fault of {name}: {faults}"


def assert_recovers_by_reset_alone(rig: Rig, drives: EmulatedDrives) -> None:
    """Fail if a drive is enabled before reset and arming, or if the robot does not work after them."""
    assert_drives_stay_off(rig, drives, rig.count_periods(t.SETTLE_S))
    rig.reset()
    assert_drives_stay_off(rig, drives, rig.count_periods(t.RESTART_S))
    if rig.authority.state == "fault":  # what was found while the cause was still there
        rig.reset()
        assert_drives_stay_off(rig, drives, rig.count_periods(t.RESTART_S))
    rig.cruise()
    assert all(drives.enabled()), f"reset and armed, and enabled are {drives.enabled()}"


def assert_switched_off(rig: Rig, drives: EmulatedDrives, since_s: float, limit_s: float) -> None:
    """Fail if a drive's own log does not show its torque off in time, and off since then."""
    assert not any(drives.enabled()), f"still enabled are {drives.enabled()}"
    for i, joint in enumerate(rig.robot.joints):
        off_s = [entry.time_s for entry in drives.torque_log() if entry.joint == i and not entry.on]
        assert off_s and off_s[-1] >= since_s, f"the log of {joint.name} does not show when its torque went off"
        took_s = off_s[-1] - since_s
        assert took_s <= limit_s, f"{joint.name} had torque for {took_s:.3f} s; at most {limit_s:.3f} s"

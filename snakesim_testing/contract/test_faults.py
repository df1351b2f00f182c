"""Faults: none in normal operation; a silent joint is detected, and stops the robot."""

import math

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import BackendRig, RigRecord
from snakesim_testing.contract.test_lifecycle import assert_at_rest

MUTED_JOINT = 1
ISOLATED_JOINT = 1


def test_a_healthy_robot_reports_no_fault(rig: BackendRig, healthy: RigRecord) -> None:
    """A healthy backend reports no fault, neither after opening nor in operation."""
    assert not rig.faults_at_opening, rig.faults_at_opening
    assert healthy.samples and not healthy.faults, healthy.faults


def test_an_isolated_joint_is_passive_while_others_continue(rig: BackendRig) -> None:
    """An isolated joint has no torque, whatever is commanded, while the other joints continue; a reset ends that."""
    with rig.with_isolation_allowed():
        start_tick = rig.tick
        rig.arm_and_move_joint()
        rig.isolate_joint(ISOLATED_JOINT)
        targets = {
            0: (JointMode.VELOCITY, tolerances.MOTION_SPEED_RAD_S),
            ISOLATED_JOINT: (
                JointMode.POSITION,
                rig.home_rad[ISOLATED_JOINT] + tolerances.STEP_RAD,
            ),
        }
        record = rig.command_joints(targets, rig.count_periods(tolerances.MOTION_DURATION_S))
        rig.assert_armed()
        assert abs(record.torque_nm[-1, ISOLATED_JOINT]) < tolerances.TORQUE_TOLERANCE_NM, (
            f"the isolated joint has a torque of {record.torque_nm[-1, ISOLATED_JOINT]:.3f} N·m"
        )
        moved_rad = np.ptp(record.angle_rad[tolerances.TRANSPORT_PERIODS :, ISOLATED_JOINT])
        assert moved_rad < tolerances.POSITION_TOLERANCE_RAD, (
            f"the isolated joint moved by {moved_rad:.3f} rad"
        )
        assert (
            record.velocity_rad_s[-1, 0]
            > (1 - tolerances.SPEED_TOLERANCE_FRACTION) * tolerances.MOTION_SPEED_RAD_S
        ), "the other joints do not continue"
        rig.disarm()
        rig.wait_periods(tolerances.TRANSPORT_PERIODS)
        rig.reset()
        rig.wait_periods(tolerances.ARMING_PERIODS)
        rig.arm()
        record = rig.command_joints(
            {ISOLATED_JOINT: targets[ISOLATED_JOINT]}, rig.count_periods(tolerances.SETTLING_TIME_S)
        )
        deviation_rad = record.angle_rad[-1, ISOLATED_JOINT] - targets[ISOLATED_JOINT][1]
        assert abs(deviation_rad) < tolerances.POSITION_TOLERANCE_RAD, (
            f"after the reset, the joint stops {deviation_rad:.3f} rad from its target"
        )
        assert not rig.record_since(start_tick).faults, rig.record_since(start_tick).faults


def test_a_silent_joint_grows_old_and_the_robot_stops(bench: Bench, rig: BackendRig) -> None:
    """A joint that sends nothing is reported as invalid or with a growing age, until the robot is at fault.

    The readings of the other joints stay fresh. Faults that the backend itself reports have a kind and a cause, and
    each of them is reported once.
    """
    if bench.mute_joint is None:
        pytest.skip("this bench cannot silence a joint; give --snakesim-mute")
    rig.arm_and_move_joint()
    rig.must_reopen = True
    mute_tick = rig.tick
    bench.mute_joint(rig.backend, MUTED_JOINT)
    lease_periods = math.ceil(rig.robot.lease_ns / rig.period_ns)
    record = rig.command_joints(
        {0: (JointMode.VELOCITY, tolerances.MOTION_SPEED_RAD_S)},
        lease_periods + tolerances.TRANSPORT_PERIODS + 2,
    )
    for joints in record.joints[tolerances.TRANSPORT_PERIODS :]:
        silent_ns = (joints.tick - mute_tick - tolerances.TRANSPORT_PERIODS) * rig.period_ns
        is_reported_as_known = joints.valid[MUTED_JOINT] and joints.age_ns[MUTED_JOINT] < silent_ns
        assert not is_reported_as_known, (
            f"the joint is silent for {silent_ns * 1e-6} ms, but its age is {joints.age_ns[MUTED_JOINT] * 1e-6} ms"
        )
        others = [i for i in range(rig.joint_count) if i != MUTED_JOINT]
        assert all(joints.valid[i] and joints.age_ns[i] <= rig.period_ns for i in others), (
            "the other joints are not fresh"
        )
    assert rig.authority.state == "fault", "the robot goes on with a joint of unknown state"
    assert_others_at_rest(rig)
    fault_count = len(rig.faults)
    assert all(fault.what and fault.cause for fault in rig.faults)
    rig.wait_periods(tolerances.TRANSPORT_PERIODS)
    assert len(rig.faults) == fault_count, (
        f"the backend reported faults again: {rig.faults[fault_count:]}"
    )
    rig.close()


def assert_others_at_rest(rig: BackendRig) -> None:
    """Fail if a joint other than the silent one moves. The position of the silent joint is unknown, and ignored."""
    record = rig.wait_periods(rig.count_periods(tolerances.SETTLING_TIME_S))
    for sample in record.samples:
        sample.joints.velocity_rad_s[MUTED_JOINT] = 0.0
        sample.joints.angle_rad[MUTED_JOINT] = 0.0
    assert_at_rest(record, rig)
    assert np.isfinite(record.angle_rad).all()

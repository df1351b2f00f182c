"""The lifecycle: nothing moves unless armed, and a stop is permanent."""

from collections.abc import Callable

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode, LifecycleState
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import BackendRig, JointTargets, RigRecord, skip_limiter

MOVE_JOINT_0: JointTargets = {0: (JointMode.VELOCITY, tolerances.MOTION_SPEED_RAD_S)}


def assert_at_rest(record: RigRecord, rig: BackendRig) -> None:
    """Fail if a joint moves at the end of a record."""
    last_velocities_rad_s = record.velocity_rad_s[-1]
    assert np.abs(last_velocities_rad_s).max() < tolerances.STANDSTILL_RAD_S, (
        f"the joints still move: {last_velocities_rad_s} rad/s"
    )
    last_angles_rad = record.angle_rad[-rig.count_periods(tolerances.SETTLING_TIME_S / 3) :]
    assert np.ptp(last_angles_rad, axis=0).max() < tolerances.STANDSTILL_RAD, (
        f"the joints still move: {np.ptp(last_angles_rad, axis=0)} rad"
    )


def test_nothing_moves_while_disarmed_whatever_is_commanded(rig: BackendRig) -> None:
    """No joint of a disarmed robot moves or has torque, even if the robot receives commands."""
    targets = {
        i: (JointMode.POSITION, rig.home_rad[i] + tolerances.STEP_RAD)
        for i in range(rig.joint_count)
    }
    start_angles_rad = np.array(rig.newest_joints.angle_rad)
    record = rig.command_joints(targets, rig.count_periods(tolerances.MOTION_DURATION_S))
    moved_rad = np.abs(record.angle_rad - start_angles_rad).max()
    assert moved_rad < tolerances.STANDSTILL_RAD, (
        f"a joint of the disarmed robot moved by {moved_rad:.3f} rad"
    )
    assert np.abs(record.torque_nm).max() < tolerances.TORQUE_TOLERANCE_NM


@pytest.mark.parametrize("state", ["disarmed", "estop"])
def test_a_robot_with_modules_stops_them_itself_when_not_armed(
    bench: Bench, rig: BackendRig, state: LifecycleState
) -> None:
    """A robot that is not armed does not follow moving setpoints, even if the host passes them by mistake.

    This is a second line of defense. A simulator need not do this (see `Backend.enact`): the host passes it none.
    """
    targets = {
        i: (JointMode.POSITION, rig.home_rad[i] + 0.5 * tolerances.STEP_RAD)
        for i in range(rig.joint_count)
    }
    start_angles_rad = np.array(rig.newest_joints.angle_rad)
    first_tick = rig.tick
    for _ in range(rig.count_periods(tolerances.MOTION_DURATION_S)):
        rig.enact_without_limiter(skip_limiter(rig.make_setpoints(targets)), state)
    rig.wait_periods(tolerances.TRANSPORT_PERIODS)  # disarmed: the only state after a stop
    moved_rad = float(np.abs(rig.record_since(first_tick).angle_rad - start_angles_rad).max())
    if moved_rad >= tolerances.STANDSTILL_RAD and bench.clock_mode == "lockstep":
        pytest.skip(
            "a simulator may follow setpoints in every state, because the host passes it only safe ones"
        )
    assert moved_rad < tolerances.STANDSTILL_RAD, (
        f"a joint moved by {moved_rad:.3f} rad in lifecycle state {state}"
    )


@pytest.mark.parametrize(
    "stop",
    [BackendRig.disarm, BackendRig.trigger_estop, BackendRig.report_fault],
    ids=["disarm", "estop", "fault"],
)
def test_leaving_armed_brings_a_moving_joint_to_rest(
    rig: BackendRig, stop: Callable[[BackendRig], None]
) -> None:
    """If a moving robot is disarmed, stopped or at fault, its joints come to rest, and commands do not move them."""
    rig.arm_and_move_joint()
    stop(rig)
    assert_at_rest(
        rig.command_joints(MOVE_JOINT_0, rig.count_periods(tolerances.SETTLING_TIME_S)), rig
    )


def test_a_fault_brakes_a_moving_joint(rig: BackendRig) -> None:
    """If a robot with stop mode `damp` or `hold` has a fault, the motor of a moving joint pushes against its motion.

    A joint without torque comes to rest as well, because of friction, but later, and on a slope perhaps not at all.
    In real time, the torque may have its peak between two samples. So the lowest torque of several faults counts.
    """
    if rig.robot.stop_mode == "passive":
        pytest.skip("the robot is described with stop mode passive: no joint brakes after a fault")
    rig.skip_without(JointMode.VELOCITY, torque=True)
    fault_count = 1 if rig.clock_mode == "lockstep" else tolerances.REALTIME_BRAKING_FAULTS
    min_torque_nm = min(measure_lowest_torque_after_fault_nm(rig) for _ in range(fault_count))
    assert min_torque_nm < -tolerances.MIN_BRAKING_TORQUE_NM, (
        f"the lowest torque after the fault is {min_torque_nm:.2f} N·m, so the moving joint is not braked; at most "
        f"{-tolerances.MIN_BRAKING_TORQUE_NM} N·m is required"
    )


def measure_lowest_torque_after_fault_nm(rig: BackendRig) -> float:
    """Move joint 0 in positive direction, report a fault, and return the lowest torque of the joint after it."""
    rig.return_home()
    rig.arm_and_move_joint()
    rig.report_fault()
    record = rig.wait_periods(
        rig.count_periods(tolerances.MAX_BRAKING_S) + tolerances.TRANSPORT_PERIODS
    )
    return float(record.torque_nm[:, 0].min())


def test_disarmed_joints_have_no_torque(rig: BackendRig) -> None:
    """The joints of a disarmed robot have no torque, also away from the start pose."""
    rig.arm()
    rig.command_joints(
        {0: (JointMode.POSITION, rig.home_rad[0] + tolerances.STEP_RAD)},
        rig.count_periods(tolerances.SETTLING_TIME_S),
    )
    rig.disarm()
    record = rig.command_joints(MOVE_JOINT_0, rig.count_periods(tolerances.SETTLING_TIME_S))
    assert np.abs(record.torque_nm[-1]).max() < tolerances.TORQUE_TOLERANCE_NM, (
        f"the disarmed joints have torques of {record.torque_nm[-1]} N·m"
    )
    assert_at_rest(record, rig)


def test_arming_again_goes_on_from_where_the_robot_is(rig: BackendRig) -> None:
    """A robot that was stopped in motion, reset and armed again stays where it is: no joint resumes a setpoint."""
    rig.arm_and_move_joint()
    rig.trigger_estop()
    rig.wait_periods(rig.count_periods(tolerances.SETTLING_TIME_S))
    rig.disarm()
    rig.wait_periods(tolerances.TRANSPORT_PERIODS)
    angles_before_arming_rad = np.array(rig.newest_joints.angle_rad)
    first_tick = rig.tick
    rig.arm()
    record = rig.record_since(first_tick)
    assert np.abs(record.angle_rad - angles_before_arming_rad).max() < tolerances.STANDSTILL_RAD, (
        f"the joints moved by {record.angle_rad[-1] - angles_before_arming_rad} rad during arming"
    )
    assert (
        np.abs(np.diff(record.torque_nm, axis=0)).max()
        < tolerances.MAX_TORQUE_STEP_FRACTION * rig.full_torque_nm[0]
    )


def test_after_reset_and_arm_it_moves_again(rig: BackendRig) -> None:
    """A robot that was stopped by a fault, reset and armed again moves as before."""
    rig.arm_and_move_joint()
    rig.report_fault()
    rig.wait_periods(rig.count_periods(tolerances.SETTLING_TIME_S))
    rig.arm_and_move_joint(joint_index=rig.joint_count - 1)

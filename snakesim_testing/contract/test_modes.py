"""Modes and units: rad, rad/s and N·m, the right joint, the right direction."""

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.recordings import PushRecording
from snakesim_testing.contract.rig import BackendRig


def test_position_mode_turns_only_the_requested_joint(rig: BackendRig) -> None:
    """Each joint in turn moves STEP_RAD from the start pose, in rad, in the right direction, and stays there."""
    rig.arm()
    for joint in range(rig.joint_count):
        record = rig.command_joints(
            {joint: (JointMode.POSITION, rig.home_rad[joint] + tolerances.STEP_RAD)},
            rig.count_periods(tolerances.SETTLING_TIME_S),
        )
        moved_rad = record.angle_rad[-1] - rig.home_rad
        assert abs(moved_rad[joint] - tolerances.STEP_RAD) < tolerances.POSITION_TOLERANCE_RAD, (
            f"joint {joint} was commanded to move by {tolerances.STEP_RAD} rad; the joints moved by {moved_rad} rad"
        )
        others_moved_rad = np.delete(moved_rad, joint)
        assert np.abs(others_moved_rad).max() < tolerances.POSITION_TOLERANCE_RAD, (
            f"only joint {joint} was commanded to move; the joints moved by {moved_rad} rad"
        )


def test_velocity_mode_turns_at_the_speed_that_is_asked(rig: BackendRig) -> None:
    """A joint in velocity mode moves at the requested speed in rad/s, in both directions, apart from friction."""
    rig.skip_without(JointMode.VELOCITY)
    rig.arm()
    for speed_rad_s in (tolerances.MOTION_SPEED_RAD_S, -tolerances.MOTION_SPEED_RAD_S):
        record = rig.command_joints(
            {0: (JointMode.VELOCITY, speed_rad_s)}, rig.count_periods(tolerances.MOTION_DURATION_S)
        )
        mean_speed_rad_s = record.velocity_rad_s[
            -rig.count_periods(tolerances.MOTION_DURATION_S / 3) :, 0
        ].mean()
        assert abs(mean_speed_rad_s - speed_rad_s) < tolerances.SPEED_TOLERANCE_FRACTION * abs(
            speed_rad_s
        ), f"the joint moved at {mean_speed_rad_s:.3f} rad/s; commanded were {speed_rad_s} rad/s"


def test_the_reported_velocity_is_the_change_of_the_reported_angle(rig: BackendRig) -> None:
    """The reported velocity, integrated over a motion, is the change of the reported angle, for every joint."""
    rig.arm()
    joint = rig.joint_count - 1
    record = rig.command_joints(
        {joint: (JointMode.VELOCITY, -tolerances.MOTION_SPEED_RAD_S)},
        rig.count_periods(tolerances.MOTION_DURATION_S),
    )
    velocity = record.velocity_rad_s
    angle = record.angle_rad
    integral = 0.5 * (velocity[1:] + velocity[:-1]).sum(axis=0) * rig.period_ns * 1e-9
    turned = angle[-1] - angle[0]
    assert turned[joint] < -tolerances.STANDSTILL_RAD, (
        "the joint did not move, so nothing can be compared"
    )
    assert np.abs(integral - turned).max() < tolerances.INTEGRATION_TOLERANCE_RAD, (
        f"the joints moved by {integral} rad by their velocity, but by {turned} rad by their angle"
    )


def test_torque_mode_pushes_with_the_torque_that_is_asked(
    rig: BackendRig, pushing: PushRecording
) -> None:
    """A joint in torque mode against its end stop reports the requested torque in N·m, with its sign."""
    rig.skip_without(JointMode.TORQUE, torque=True)
    assert pushing.torque_mode is not None
    measured_nm = pushing.torque_mode.torque_nm[-1]
    requested_nm = pushing.requested_nm
    tolerance_nm = (
        tolerances.TORQUE_TOLERANCE_FRACTION * requested_nm + tolerances.TORQUE_TOLERANCE_NM
    )
    assert abs(measured_nm[0] - requested_nm) < tolerance_nm, (
        f"joint 0 pushes with {measured_nm[0]:.3f} N·m; commanded were {requested_nm:.2f} N·m"
    )
    assert abs(measured_nm[1] + requested_nm) < tolerance_nm, (
        f"joint 1 pushes with {measured_nm[1]:.3f} N·m; commanded were {-requested_nm:.2f} N·m"
    )


def test_a_passive_joint_has_no_torque_and_stays(rig: BackendRig) -> None:
    """An armed joint that becomes passive away from the start pose has no torque, and stays where it is."""
    rig.arm()
    rig.command_joints(
        {0: (JointMode.POSITION, rig.home_rad[0] + tolerances.STEP_RAD)},
        rig.count_periods(tolerances.SETTLING_TIME_S),
    )
    record = rig.command_joints(
        {0: (JointMode.PASSIVE, 0.0)}, rig.count_periods(tolerances.SETTLING_TIME_S)
    )
    assert abs(record.torque_nm[-1, 0]) < tolerances.TORQUE_TOLERANCE_NM, (
        f"the passive joint has a torque of {record.torque_nm[-1, 0]:.3f} N·m"
    )
    settled = record.angle_rad[tolerances.TRANSPORT_PERIODS :, 0]
    assert np.ptp(settled) < tolerances.POSITION_TOLERANCE_RAD, (
        f"the passive joint moved by {np.ptp(settled):.3f} rad"
    )


def test_joints_may_be_in_different_modes_at_once(rig: BackendRig) -> None:
    """Joints in position, velocity and passive mode at the same time each follow their own mode."""
    rig.arm()
    target_rad = rig.home_rad[0] - tolerances.STEP_RAD
    speed_rad_s = tolerances.MOTION_SPEED_RAD_S
    targets = {
        0: (JointMode.POSITION, target_rad),
        1: (JointMode.VELOCITY, speed_rad_s),
        rig.joint_count - 1: (JointMode.PASSIVE, 0.0),
    }
    record = rig.command_joints(targets, rig.count_periods(tolerances.MOTION_DURATION_S))
    # Still on its way.
    assert abs(record.angle_rad[-1, 0] - target_rad) < 2 * tolerances.POSITION_TOLERANCE_RAD
    assert (
        abs(record.velocity_rad_s[-1, 1] - speed_rad_s)
        < tolerances.SPEED_TOLERANCE_FRACTION * speed_rad_s
    )
    moved_rad = record.angle_rad[-1] - rig.home_rad
    assert abs(moved_rad[-1]) < tolerances.POSITION_TOLERANCE_RAD, (
        f"the passive joint moved by {moved_rad[-1]:.3f} rad"
    )


def test_setpoints_hold_until_the_next_ones(rig: BackendRig) -> None:
    """A joint without new commands keeps its setpoint while the command lease lasts."""
    rig.skip_without(JointMode.VELOCITY)
    rig.arm_and_move_joint()
    rig.wait_periods(tolerances.COMMAND_GAP_PERIODS)
    assert_joint_0_keeps_speed(rig)


def test_setpoints_hold_without_being_handed_over_again(rig: BackendRig) -> None:
    """The last setpoints stay active while the backend only advances, without a further call of `enact`."""
    rig.skip_without(JointMode.VELOCITY)
    rig.arm_and_move_joint()
    for _ in range(tolerances.HOLD_PERIODS):
        rig.advance_period()
    assert_joint_0_keeps_speed(rig)


def test_a_mode_that_a_joint_lacks_is_refused(rig: BackendRig) -> None:
    """A command in a mode that a joint does not have is refused as a whole, and the backend gets no such setpoint."""
    missing_modes = [mode for mode in JointMode if not rig.supports_mode(0, mode)]
    if not missing_modes:
        pytest.skip(f"{rig.robot.joints[0].name} is described with every mode")
    rig.arm()
    for mode in missing_modes:
        rejected_count = rig.authority.rejected_counts["wrong_mode"]
        setpoints = rig.make_setpoints({})
        setpoints.mode[0] = mode
        setpoints.target[0] = tolerances.MOTION_SPEED_RAD_S
        record = rig.send_command(setpoints)
        assert rig.authority.rejected_counts["wrong_mode"] == rejected_count + 1, (
            f"{mode.name.lower()} mode was accepted"
        )
        assert np.abs(record.angle_rad - rig.home_rad).max() < tolerances.POSITION_TOLERANCE_RAD, (
            "a joint moved after a rejected command"
        )
        assert all(mode not in points.mode for points in record.setpoints)


def assert_joint_0_keeps_speed(rig: BackendRig) -> None:
    """Fail if joint 0 no longer moves at the commanded speed."""
    speed = rig.newest_joints.velocity_rad_s[0]
    assert speed > (1 - tolerances.SPEED_TOLERANCE_FRACTION) * tolerances.MOTION_SPEED_RAD_S, (
        f"joint 0 moves at {speed:.3f} rad/s; commanded were {tolerances.MOTION_SPEED_RAD_S} rad/s"
    )

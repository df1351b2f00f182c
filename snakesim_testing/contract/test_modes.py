"""Modes and units: rad, rad/s and N·m, the right joint, the right direction."""

import numpy as np
import pytest

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.recordings import Pushing
from snakesim_testing.contract.rig import Rig


def test_position_mode_turns_only_the_requested_joint(rig: Rig) -> None:
    """Each joint in turn moves STEP_RAD from the start pose, in rad, in the right direction, and stays there."""
    rig.arm()
    for joint in range(rig.count):
        angles = rig.drive({joint: (Mode.POSITION, rig.home_rad[joint] + t.STEP_RAD)}, rig.count_periods(t.SETTLE_S))
        moved = angles.angle_rad[-1] - rig.home_rad
        assert abs(moved[joint] - t.STEP_RAD) < t.REACHED_RAD, f"joint {joint} asked for {t.STEP_RAD} rad: {moved} rad"
        others = np.delete(moved, joint)
        assert np.abs(others).max() < t.REACHED_RAD, f"only joint {joint} was asked to move: {moved} rad"


def test_velocity_mode_turns_at_the_speed_that_is_asked(rig: Rig) -> None:
    """In both directions, in rad/s; friction may reduce a motor's speed."""
    rig.skip_without(Mode.VELOCITY)
    rig.arm()
    for speed in (t.CRUISE_RAD_S, -t.CRUISE_RAD_S):
        record = rig.drive({0: (Mode.VELOCITY, speed)}, rig.count_periods(t.CRUISE_S))
        last = record.velocity_rad_s[-rig.count_periods(t.CRUISE_S / 3) :, 0].mean()
        assert abs(last - speed) < t.SPEED_SHARE * abs(speed), f"asked for {speed} rad/s: {last:.3f} rad/s"


def test_the_reported_velocity_is_the_change_of_the_reported_angle(rig: Rig) -> None:
    """Integrated over a motion, velocity gives the angle: same unit, same sign, same joint."""
    rig.arm()
    joint = rig.count - 1
    record = rig.drive({joint: (Mode.VELOCITY, -t.CRUISE_RAD_S)}, rig.count_periods(t.CRUISE_S))
    velocity = record.velocity_rad_s
    angle = record.angle_rad
    integral = 0.5 * (velocity[1:] + velocity[:-1]).sum(axis=0) * rig.period_ns * 1e-9
    turned = angle[-1] - angle[0]
    assert turned[joint] < -t.STILL_RAD, "the joint did not move, so nothing can be compared"
    assert np.abs(integral - turned).max() < t.INTEGRAL_RAD, f"turned {integral} rad by velocity, {turned} by angle"


def test_torque_mode_pushes_with_the_torque_that_is_asked(rig: Rig, pushing: Pushing) -> None:
    """Against a stop the reported torque is the one asked for, in N·m, with its sign."""
    rig.skip_without(Mode.TORQUE, torque=True)
    assert pushing.torque_mode is not None
    measured_nm = pushing.torque_mode.torque_nm[-1]
    asked = pushing.asked_nm
    slack = t.TORQUE_SHARE * asked + t.TORQUE_NM
    assert abs(measured_nm[0] - asked) < slack, f"asked for {asked:.2f} N·m: {measured_nm[0]:.3f} N·m"
    assert abs(measured_nm[1] + asked) < slack, f"asked for {-asked:.2f} N·m: {measured_nm[1]:.3f} N·m"


def test_a_passive_joint_has_no_torque_and_stays(rig: Rig) -> None:
    """Armed and passive: released away from the start pose, a joint stays where it is, without torque."""
    rig.arm()
    rig.drive({0: (Mode.POSITION, rig.home_rad[0] + t.STEP_RAD)}, rig.count_periods(t.SETTLE_S))
    record = rig.drive({0: (Mode.PASSIVE, 0.0)}, rig.count_periods(t.SETTLE_S))
    assert abs(record.torque_nm[-1, 0]) < t.TORQUE_NM, f"{record.torque_nm[-1, 0]:.3f} N·m"
    settled = record.angle_rad[t.TRANSPORT_PERIODS :, 0]
    assert np.ptp(settled) < t.REACHED_RAD, f"it moved by {np.ptp(settled):.3f} rad"


def test_joints_may_be_in_different_modes_at_once(rig: Rig) -> None:
    """Position, velocity, passive and position again, side by side: each does its own."""
    rig.arm()
    step = rig.home_rad[0] - t.STEP_RAD
    speed = t.CRUISE_RAD_S
    asked = {0: (Mode.POSITION, step), 1: (Mode.VELOCITY, speed), rig.count - 1: (Mode.PASSIVE, 0.0)}
    record = rig.drive(asked, rig.count_periods(t.CRUISE_S))
    assert abs(record.angle_rad[-1, 0] - step) < 2 * t.REACHED_RAD  # still on its way
    assert abs(record.velocity_rad_s[-1, 1] - speed) < t.SPEED_SHARE * speed
    still = record.angle_rad[-1] - rig.home_rad
    assert abs(still[-1]) < t.REACHED_RAD, f"the passive joint moved by {still[-1]:.3f} rad"


def test_setpoints_hold_until_the_next_ones(rig: Rig) -> None:
    """Without commands for less than a lease the joint keeps its setpoint."""
    rig.skip_without(Mode.VELOCITY)
    rig.cruise()
    rig.idle(t.LAPSE_PERIODS)
    assert_cruising(rig)


def test_setpoints_hold_without_being_handed_over_again(rig: Rig) -> None:
    """`advance` alone keeps the last setpoints active."""
    rig.skip_without(Mode.VELOCITY)
    rig.cruise()
    for _ in range(t.HELD_PERIODS):
        rig.advance_period()
    assert_cruising(rig)


def test_a_mode_that_a_joint_lacks_is_refused(rig: Rig) -> None:
    """Described without a mode, a joint is never given a setpoint in it: the command is refused as a whole."""
    missing = [mode for mode in Mode if not rig.supports_mode(0, mode)]
    if not missing:
        pytest.skip(f"{rig.robot.joints[0].name} is described with every mode")
    rig.arm()
    for mode in missing:
        refused = rig.authority.rejected_counts["wrong_mode"]
        wrong = rig.make_setpoints({})
        wrong.mode[0], wrong.target[0] = mode, t.CRUISE_RAD_S
        record = rig.send_command(wrong)
        assert rig.authority.rejected_counts["wrong_mode"] == refused + 1, f"{mode.name.lower()} mode was accepted"
        assert np.abs(record.angle_rad - rig.home_rad).max() < t.REACHED_RAD, "it moved"
        assert all(mode not in points.mode for points in record.setpoints)


def assert_cruising(rig: Rig) -> None:
    """Fail when joint 0 has slowed down."""
    speed = rig.newest_joints.velocity_rad_s[0]
    assert speed > (1 - t.SPEED_SHARE) * t.CRUISE_RAD_S, f"{speed:.3f} rad/s, commanded were {t.CRUISE_RAD_S} rad/s"

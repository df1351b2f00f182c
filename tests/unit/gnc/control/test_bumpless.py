"""Tests hand-overs between joints: in the tick of a change, the setpoint of a motor continues its present torque."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_gnc.control.bumpless import BumplessTransfer
from snakesim_hal.safety.limiter import compute_bumpless_target
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.gnc.stage import make_robot
from snakesim_testing.hal.small_robots import make_joint_state

ROBOT = make_robot(4)
joint_values = st.lists(st.floats(-1, 1), min_size=4, max_size=4)


def compute_bumpless_targets(mode: JointMode, angles_rad, velocities_rad_s, torques_nm):
    """Return the targets that do not change the torques, as the HAL's limiter computes them."""
    measured_joints = zip(ROBOT.joints, angles_rad, velocities_rad_s, torques_nm, strict=True)
    return [
        compute_bumpless_target(joint, mode, angle_rad, velocity_rad_s, torque_nm)
        for joint, angle_rad, velocity_rad_s, torque_nm in measured_joints
    ]


@given(joint_values, joint_values, joint_values, joint_values)
def test_bumpless_start_keeps_present_motor_torques(angle, velocity, torque, reference):
    hand_over = BumplessTransfer(ROBOT)
    hand_over.start_in_position_mode(
        make_joint_state(ROBOT, angle, velocity, torque), np.array(reference)
    )
    targets = hand_over.compute_position_targets_rad(np.array(reference))
    assert targets == pytest.approx(
        compute_bumpless_targets(JointMode.POSITION, angle, velocity, torque)
    )


@given(joint_values, joint_values, joint_values, joint_values, st.floats(-5, 5), st.floats(0, 1))
def test_bumpless_hand_over_moves_targets_at_most_by_the_fade(
    angle, velocity, torque, reference, requested_nm, fade
):
    """Joint 2 gives up the torque mode, and joint 1 takes it over."""
    measured = make_joint_state(ROBOT, angle, velocity, torque)
    reference_rad = np.array(reference)
    hand_over = BumplessTransfer(ROBOT)
    hand_over.switch_torque_joint(2, measured, reference_rad)
    hand_over.advance_ramps(1.0)
    hand_over.switch_torque_joint(1, measured, reference_rad)
    hand_over.advance_ramps(fade)
    # Each target moves at most by the fraction `fade` of its way.
    start_rad = compute_bumpless_targets(JointMode.POSITION, angle, velocity, torque)[2]
    target_rad = hand_over.compute_position_targets_rad(reference_rad)[2]
    assert abs(target_rad - start_rad) <= fade * abs(start_rad - reference_rad[2]) + 1e-9
    target_nm = hand_over.compute_torque_target_nm(requested_nm)
    assert abs(target_nm - torque[1]) <= fade * abs(requested_nm - torque[1]) + 1e-9


def test_bumpless_switch_to_same_joint_continues_its_ramp():
    hand_over = BumplessTransfer(ROBOT)
    measured = make_joint_state(ROBOT, torque=3.0)
    hand_over.switch_torque_joint(1, measured, np.zeros(4))
    hand_over.advance_ramps(0.6)
    hand_over.switch_torque_joint(1, measured, np.zeros(4))
    assert hand_over.compute_torque_target_nm(0.0) == pytest.approx(1.2)


def test_bumpless_new_reference_keeps_targets_and_fades_differences():
    hand_over = BumplessTransfer(ROBOT)
    hand_over.start_in_position_mode(make_joint_state(ROBOT, 0.5), np.zeros(4))
    hand_over.absorb_reference_jump(np.full(4, 0.2))
    assert hand_over.compute_position_targets_rad(np.full(4, 0.2)) == pytest.approx([0.5] * 4)
    for _ in range(200):
        hand_over.advance_ramps(0.05)
    assert hand_over.compute_position_targets_rad(np.full(4, 0.2)) == pytest.approx(
        [0.2] * 4, abs=1e-3
    )

"""Hand-over between joints: what a motor is told in the tick of a change goes on from what it is doing."""

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
values = st.lists(st.floats(-1, 1), min_size=4, max_size=4)


def bumpless(mode: JointMode, angle, velocity, torque):
    """What the HAL's own limiter takes for the target that changes nothing."""
    parts = zip(ROBOT.joints, angle, velocity, torque, strict=True)
    return [compute_bumpless_target(joint, mode, q, speed, push) for joint, q, speed, push in parts]


@given(values, values, values, values)
def test_bumpless_starts_from_present_motor_targets(angle, velocity, torque, reference):
    hand_over = BumplessTransfer(ROBOT)
    hand_over.start_in_position_mode(
        make_joint_state(ROBOT, angle, velocity, torque), np.array(reference)
    )
    targets = hand_over.compute_position_targets_rad(np.array(reference))
    assert targets == pytest.approx(bumpless(JointMode.POSITION, angle, velocity, torque))


@given(values, values, values, values, st.floats(-5, 5), st.floats(0, 1))
def test_nothing_jumps_by_more_than_the_fade(angle, velocity, torque, reference, wanted, fade):
    """A released joint and one that takes over: within `fade` times the way that is left."""
    measured, reference = make_joint_state(ROBOT, angle, velocity, torque), np.array(reference)
    hand_over = BumplessTransfer(ROBOT)
    hand_over.switch_torque_joint(2, measured, reference)
    hand_over.advance_ramps(1.0)
    hand_over.switch_torque_joint(1, measured, reference)
    hand_over.advance_ramps(fade)
    held = bumpless(JointMode.POSITION, angle, velocity, torque)
    position = hand_over.compute_position_targets_rad(reference)[2]
    assert abs(position - held[2]) <= fade * abs(held[2] - reference[2]) + 1e-9
    assert (
        abs(hand_over.compute_torque_target_nm(wanted) - torque[1])
        <= fade * abs(wanted - torque[1]) + 1e-9
    )


def test_the_same_joint_keeps_its_turn():
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

"""Between a joint and the shaft of its drive: there and back, and the physics that both see."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.hal.small_robots import make_robot_file

MIXED = {
    "joint_1": {"sign": -1, "zero_rad": 3.0, "gear": 9.0, "angle_min_rad": -0.4},
    "joint_3": {"sign": 1, "zero_rad": -0.2},
}
mounting = DriveMounting(make_robot_file(joints=MIXED).joint_table)
plain = DriveMounting(make_robot_file().joint_table)
numbers = st.lists(st.floats(-10, 10), min_size=3, max_size=3).map(np.array)


def test_mounting_reversed_geared_drive_turns_opposite_with_less_torque() -> None:
    assert mounting.to_drive_angle_rad(np.array([0.1, 0.1, 0.1])) == pytest.approx(
        [3.0 - 0.9, 0.1, -0.1]
    )
    assert mounting.to_drive_velocity_rad_s(np.ones(3)).tolist() == [-9.0, 1.0, 1.0]
    assert mounting.to_drive_torque_nm(np.full(3, 1.8)) == pytest.approx([-0.2, 1.8, 1.8])
    assert mounting.to_drive_torque_limit_nm(np.full(3, 1.8)) == pytest.approx([0.2, 1.8, 1.8]), (
        "limits have no sign"
    )


@given(angle=numbers, velocity=numbers, torque=numbers)
def test_mounting_conversion_is_invertible_and_preserves_power(
    angle: np.ndarray, velocity: np.ndarray, torque: np.ndarray
) -> None:
    assert mounting.to_joint_angle_rad(mounting.to_drive_angle_rad(angle)) == pytest.approx(
        angle, abs=1e-12
    )
    speeds, torques = (
        mounting.to_drive_velocity_rad_s(velocity),
        mounting.to_drive_torque_nm(torque),
    )
    assert mounting.to_joint_velocity_rad_s(speeds) == pytest.approx(velocity)
    assert mounting.to_joint_torque_nm(torques) == pytest.approx(torque)
    assert speeds * torques == pytest.approx(velocity * torque), "a gear makes no power"


@given(values=numbers)
def test_plainly_mounted_drives_have_the_joints_numbers_to_the_bit(values: np.ndarray) -> None:
    for there, back in (
        (plain.to_drive_angle_rad, plain.to_joint_angle_rad),
        (plain.to_drive_velocity_rad_s, plain.to_joint_velocity_rad_s),
        (plain.to_drive_torque_nm, plain.to_joint_torque_nm),
    ):
        assert there(values).tolist() == values.tolist() == back(values).tolist()


def test_targets_are_converted_by_the_mode_of_each_joint() -> None:
    asked = [1.0, 1.0, 0.5]
    assert mounting.to_drive_targets([JointMode.POSITION] * 3, asked) == pytest.approx(
        [-6.0, 1.0, 0.3]
    )
    assert mounting.to_drive_targets(
        [JointMode.VELOCITY, JointMode.TORQUE, JointMode.PASSIVE], asked
    ).tolist() == [
        -9.0,
        1.0,
        0.0,
    ]
    assert mounting.to_drive_targets([JointMode.TORQUE] * 3, asked) == pytest.approx(
        [-1 / 9, 1.0, 0.5]
    )

"""The mounting converts between a joint and the shaft of its drive, and preserves power."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.hal.small_robots import make_robot_file

JOINT_OVERRIDES = {
    "joint_1": {"sign": -1, "zero_rad": 3.0, "gear": 9.0, "angle_min_rad": -0.4},
    "joint_3": {"sign": 1, "zero_rad": -0.2},
}
mounting = DriveMounting(make_robot_file(joints=JOINT_OVERRIDES).joint_table)
direct_mounting = DriveMounting(make_robot_file().joint_table)
three_numbers = st.lists(st.floats(-10, 10), min_size=3, max_size=3).map(np.array)


def test_mounting_reversed_geared_drive_turns_opposite_with_less_torque() -> None:
    assert mounting.to_drive_angle_rad(np.array([0.1, 0.1, 0.1])) == pytest.approx(
        [3.0 - 0.9, 0.1, -0.1]
    )
    assert mounting.to_drive_velocity_rad_s(np.ones(3)).tolist() == [-9.0, 1.0, 1.0]
    assert mounting.to_drive_torque_nm(np.full(3, 1.8)) == pytest.approx([-0.2, 1.8, 1.8])
    assert mounting.to_drive_torque_limit_nm(np.full(3, 1.8)) == pytest.approx([0.2, 1.8, 1.8]), (
        "limits have no sign"
    )


@given(angle=three_numbers, velocity=three_numbers, torque=three_numbers)
def test_mounting_conversion_is_invertible_and_preserves_power(
    angle: np.ndarray, velocity: np.ndarray, torque: np.ndarray
) -> None:
    assert mounting.to_joint_angle_rad(mounting.to_drive_angle_rad(angle)) == pytest.approx(
        angle, abs=1e-12
    )
    drive_velocity = mounting.to_drive_velocity_rad_s(velocity)
    drive_torque = mounting.to_drive_torque_nm(torque)
    assert mounting.to_joint_velocity_rad_s(drive_velocity) == pytest.approx(velocity)
    assert mounting.to_joint_torque_nm(drive_torque) == pytest.approx(torque)
    assert drive_velocity * drive_torque == pytest.approx(velocity * torque), (
        "a gear does not change the power"
    )


@given(values=three_numbers)
def test_mounting_of_direct_drive_changes_no_bit(values: np.ndarray) -> None:
    for to_drive, to_joint in (
        (direct_mounting.to_drive_angle_rad, direct_mounting.to_joint_angle_rad),
        (direct_mounting.to_drive_velocity_rad_s, direct_mounting.to_joint_velocity_rad_s),
        (direct_mounting.to_drive_torque_nm, direct_mounting.to_joint_torque_nm),
    ):
        assert to_drive(values).tolist() == values.tolist() == to_joint(values).tolist()


def test_mounting_converts_targets_by_the_mode_of_each_joint() -> None:
    targets = [1.0, 1.0, 0.5]
    assert mounting.to_drive_targets([JointMode.POSITION] * 3, targets) == pytest.approx(
        [-6.0, 1.0, 0.3]
    )
    assert mounting.to_drive_targets(
        [JointMode.VELOCITY, JointMode.TORQUE, JointMode.PASSIVE], targets
    ).tolist() == [
        -9.0,
        1.0,
        0.0,
    ]
    assert mounting.to_drive_targets([JointMode.TORQUE] * 3, targets) == pytest.approx(
        [-1 / 9, 1.0, 0.5]
    )

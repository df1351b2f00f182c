"""Compares the ROS frame tree with our kinematics, and the URDF with what MuJoCo reads from it."""

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    rotation_from_quaternion,
    yaw_from_rotation,
)
from snakesim_operator.features.ros2.frames import OPTICAL_IN_CAMERA, RobotFrames, make_ros_name
from snakesim_operator.features.ros2.messages import RosTransform
from snakesim_operator.features.ros2.urdf import make_urdf
from snakesim_testing.hal.small_robots import make_joint_state, make_pose
from snakesim_testing.operator.ros2_robots import describe_shipped_robot


def find_pose_in_map(tree: list[RosTransform], frame: str) -> tuple[Floats, Floats]:
    """Return the position (3,) and the rotation (3, 3) of a frame in the root frame `map`."""
    transform_by_child = {transform.child: transform for transform in tree}
    position: Floats = np.zeros(3)
    rotation: Floats = np.eye(3)
    while frame in transform_by_child:
        transform = transform_by_child[frame]
        frame_rotation = rotation_from_quaternion(transform.orientation_wxyz)
        position = np.array(transform.position_m) + frame_rotation @ position
        rotation = frame_rotation @ rotation
        frame = transform.parent
    assert frame == "map"
    return position, rotation


@pytest.mark.parametrize("name", ["planar13", "mamba"])
def test_ros_frame_tree_equals_kinematics(name: str) -> None:
    robot = describe_shipped_robot(name)
    frames = RobotFrames(robot, "lab/")
    rng = np.random.default_rng(3)
    angles_rad = rng.uniform(-0.9, 0.9, len(robot.joints)).tolist()
    orientation_wxyz = (float(np.cos(0.3)), 0.0, 0.0, float(np.sin(0.3)))
    base_pose = make_pose(position_w=(1.0, 2.0, 0.05), orientation_wxyz=orientation_wxyz)
    tree = [
        *frames.fixed,
        frames.make_base_transform(base_pose),
        *frames.make_joint_transforms(make_joint_state(robot, angles_rad)),
    ]
    origins, rotations = compute_link_frames(
        base_pose.position_w,
        rotation_from_quaternion(orientation_wxyz),
        angles_rad,
        [joint.axis for joint in robot.joints],
        [link.length_m for link in robot.links],
    )
    for i in range(len(robot.links)):
        position, rotation = find_pose_in_map(tree, f"lab/{robot.links[i].name}")
        assert np.allclose(position, origins[i])
        assert np.allclose(rotation, rotations[i])


def test_ros_optical_frame_looks_along_z() -> None:
    optical = rotation_from_quaternion(OPTICAL_IN_CAMERA)
    right, down, forward = optical.T
    assert np.allclose(forward, [1, 0, 0])
    assert np.allclose(right, [0, -1, 0])
    assert np.allclose(down, [0, 0, -1])
    assert yaw_from_rotation(np.eye(3)) == 0.0


def test_ros_frame_names_are_valid() -> None:
    assert [make_ros_name(text) for text in ("head", "2d-front", "ö")] == ["head", "_2d_front", "_"]


@pytest.mark.parametrize("name", ["planar13", "mamba"])
def test_ros_urdf_in_mujoco_has_joints_axes_and_masses(name: str) -> None:
    robot = describe_shipped_robot(name)
    document = make_urdf(robot, "lab/")
    assert "has neither inertia nor friction" in document, (
        "a comment in the document lists what it omits"
    )
    model = mujoco.MjModel.from_xml_string(document)
    assert model.njnt == len(robot.joints)
    for i, joint in enumerate(robot.joints):
        assert model.joint(i).name == joint.name
        assert model.joint(i).range.tolist() == pytest.approx(
            [joint.angle_min_rad, joint.angle_max_rad]
        )
        assert model.joint(i).axis.tolist() == ([0, 0, 1] if joint.axis == "yaw" else [0, 1, 0])
    moving_mass_kg = sum(link.mass_kg for link in robot.links[1:])  # MuJoCo fixes the first link
    assert model.body_mass.sum() == pytest.approx(moving_mass_kg)

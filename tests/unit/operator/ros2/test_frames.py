"""The tree of frames and the URDF, against our kinematics and MuJoCo's own URDF reader."""

import mujoco
import numpy as np
import pytest

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

Pair = tuple[np.ndarray, np.ndarray]


def walked(tree: list[RosTransform], to: str) -> Pair:
    """Pose of a frame in the root: position and rotation."""
    above = {one.child: one for one in tree}
    position, rotation = np.zeros(3), np.eye(3)
    while to in above:
        one = above[to]
        turn = rotation_from_quaternion(one.orientation_wxyz)
        position, rotation = np.array(one.position_m) + turn @ position, turn @ rotation
        to = one.parent
    assert to == "map"
    return position, rotation


@pytest.mark.parametrize("name", ["planar13", "mamba"])
def test_ros_frame_tree_equals_kinematics(name: str) -> None:
    robot = describe_shipped_robot(name)
    frames = RobotFrames(robot, "lab/")
    random = np.random.default_rng(3)
    angles = random.uniform(-0.9, 0.9, len(robot.joints)).tolist()
    turned = (float(np.cos(0.3)), 0.0, 0.0, float(np.sin(0.3)))
    at = make_pose(position_w=(1.0, 2.0, 0.05), orientation_wxyz=turned)
    tree = [
        *frames.fixed,
        frames.make_base_transform(at),
        *frames.make_joint_transforms(make_joint_state(robot, angles)),
    ]
    origins, rotations = compute_link_frames(
        at.position_w,
        rotation_from_quaternion(turned),
        angles,
        [joint.axis for joint in robot.joints],
        [link.length_m for link in robot.links],
    )
    for i in range(len(robot.links)):
        position, rotation = walked(tree, f"lab/{robot.links[i].name}")
        assert np.allclose(position, origins[i])
        assert np.allclose(rotation, rotations[i])


def test_optical_frames_look_along_z() -> None:
    optical = rotation_from_quaternion(OPTICAL_IN_CAMERA)
    right, down, forward = optical.T
    assert np.allclose(forward, [1, 0, 0])
    assert np.allclose(right, [0, -1, 0])
    assert np.allclose(down, [0, 0, -1])
    assert yaw_from_rotation(np.eye(3)) == 0.0


def test_ros_frame_names_are_valid() -> None:
    assert [make_ros_name(text) for text in ("head", "2d-front", "ö")] == ["head", "_2d_front", "_"]


@pytest.mark.parametrize("name", ["planar13", "mamba"])
def test_the_urdf_is_read_by_mujoco(name: str) -> None:
    robot = describe_shipped_robot(name)
    document = make_urdf(robot, "lab/")
    assert "has neither inertia nor friction" in document, (
        "what a reader would miss is said in the document"
    )
    model = mujoco.MjModel.from_xml_string(document)
    assert model.njnt == len(robot.joints)
    for i, joint in enumerate(robot.joints):
        assert model.joint(i).name == joint.name
        assert model.joint(i).range.tolist() == pytest.approx(
            [joint.angle_min_rad, joint.angle_max_rad]
        )
        assert model.joint(i).axis.tolist() == ([0, 0, 1] if joint.axis == "yaw" else [0, 1, 0])
    moving = sum(link.mass_kg for link in robot.links[1:])  # the first is welded to the world there
    assert model.body_mass.sum() == pytest.approx(moving)

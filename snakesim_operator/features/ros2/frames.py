"""Frames of the robot by their ROS names (REP 105), and their poses.

    map -> odom -> base_link -> the tail link -> ... -> the head link -> sensors

`map` and `odom` are the world of guidance; they coincide, because there is one estimate of the pose, without a
separate drift. `base_link` is the base: tail end of the tail link, x along it, y to the left, z upwards (REP 103).
Links are named as in the robot's description. An optical frame has z forward, x to the right and y downwards.
"""

import math
import re

from snakesim_hal.wire.messages import ColorImage, DepthImage, Description, JointState, MountedSample, Pose, World
from snakesim_operator.features.ros2.messages import Transform, Triple, Wxyz

MAP = "map"
NOWHERE: Triple = (0.0, 0.0, 0.0)
UNTURNED: Wxyz = (1.0, 0.0, 0.0, 0.0)
OPTICAL_IN_CAMERA: Wxyz = (0.5, -0.5, 0.5, -0.5)


def ros_name(text: str) -> str:
    """A name as ROS allows it in a topic: letters, digits and _, not a digit first."""
    word = re.sub(r"\W", "_", text, flags=re.ASCII)
    return word if not word[:1].isdigit() else f"_{word}"


class Frames:
    """The frames of one robot. prefix: before every name but `map`, such as `planar13/`; empty for a single robot."""

    def __init__(self, robot: Description, prefix: str = "") -> None:
        self._robot, self._prefix = robot, prefix
        self.odom, self.base = f"{prefix}odom", f"{prefix}base_link"
        at_base = Transform(self.base, self.link(0), NOWHERE, UNTURNED)
        self.fixed = [Transform(MAP, self.odom, NOWHERE, UNTURNED), at_base]

    def link(self, index: int) -> str:
        """Frame of a link."""
        return self._prefix + self._robot.links[index].name

    def optical(self, kind: str, camera: str) -> str:
        """Frame of a camera's images. kind: depth or color."""
        return f"{self._prefix}{ros_name(camera)}_{kind}_optical_frame"

    def mount(self, sensor: str) -> str:
        """Frame of a lidar, a range finder, or a sensor with a message of its own."""
        return f"{self._prefix}{ros_name(sensor)}_frame"

    def imu(self, index: int) -> str:
        """Frame of the IMU of a link."""
        return f"{self.link(index)}_imu_frame"

    def of_imu(self, index: int) -> Transform:
        """An IMU in the middle of its link."""
        middle = (self._robot.links[index].length_m / 2, 0.0, 0.0)
        return Transform(self.link(index), self.imu(index), middle, UNTURNED)

    def of_base(self, pose: World | Pose) -> Transform:
        """The base in odom."""
        if isinstance(pose, Pose):
            return Transform(self.odom, self.base, pose.position_w, pose.orientation_wxyz)
        return Transform(self.odom, self.base, pose.base_position_w, pose.base_orientation_wxyz)

    def of_joints(self, joints: JointState) -> list[Transform]:
        """Every link in the one behind it; those whose joint is not valid are left out."""
        found: list[Transform] = []
        for i, joint in enumerate(self._robot.joints):
            if joints.valid[i]:
                position = (self._robot.links[i].length_m, 0.0, 0.0)
                turn = _turned(joint.axis, joints.angle_rad[i])
                found.append(Transform(self.link(i), self.link(i + 1), position, turn))
        return found

    def of_camera(self, kind: str, camera: str, seen: DepthImage | ColorImage) -> list[Transform]:
        """A camera on its link, and its optical frame in it."""
        optical = self.optical(kind, camera)
        body = optical.replace("_optical_frame", "_frame")
        mount = Transform(self.link(seen.link), body, seen.position_l, seen.orientation_l_wxyz)
        return [mount, Transform(body, optical, NOWHERE, OPTICAL_IN_CAMERA)]

    def of_mount(self, sensor: str, seen: MountedSample) -> list[Transform]:
        """That sensor on its link."""
        return [Transform(self.link(seen.link), self.mount(sensor), seen.position_l, seen.orientation_l_wxyz)]


def _turned(axis: str, angle_rad: float) -> Wxyz:
    """A joint's turn: yaw about z, pitch about y."""
    c, s = math.cos(angle_rad / 2), math.sin(angle_rad / 2)
    return (c, 0.0, 0.0, s) if axis == "yaw" else (c, 0.0, s, 0.0)

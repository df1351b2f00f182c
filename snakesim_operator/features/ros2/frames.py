"""Names the robot's frames as ROS expects them (REP 105), and computes their poses.

    map -> odom -> base_link -> the tail link -> ... -> the head link -> sensors

`map` and `odom` are the world frame of the navigation; they coincide, because there is a single pose estimate without
a separate drift. `base_link` is the base: the tail end of the tail link, x along it, y to the left, z upwards
(REP 103). Links are named as in the robot's description. An optical frame has z forward, x to the right, y downwards.
"""

import math
import re

from snakesim_hal.wire.messages import (
    ColorImage,
    DepthImage,
    JointState,
    MountedSample,
    Pose,
    RobotDescription,
    WorldModel,
)
from snakesim_operator.features.ros2.messages import RosTransform, Triple, Wxyz

MAP_FRAME = "map"
ORIGIN: Triple = (0.0, 0.0, 0.0)
NO_ROTATION: Wxyz = (1.0, 0.0, 0.0, 0.0)
OPTICAL_IN_CAMERA: Wxyz = (0.5, -0.5, 0.5, -0.5)


def make_ros_name(text: str) -> str:
    """Return a text as a valid ROS name: letters, digits and _, without a leading digit."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII)
    if name[:1].isdigit():
        return f"_{name}"
    return name


class RobotFrames:
    """The frames of one robot: their names, and the transforms between them."""

    def __init__(self, robot: RobotDescription, prefix: str = "") -> None:
        """Name the frames of the robot.

        Args:
            robot: Description of the robot.
            prefix: Text before every frame name but `map`, such as `planar13/`; empty for a single robot.
        """
        self._robot = robot
        self._prefix = prefix
        self.odom = f"{prefix}odom"
        self.base = f"{prefix}base_link"
        self.fixed = [
            RosTransform(MAP_FRAME, self.odom, ORIGIN, NO_ROTATION),
            RosTransform(self.base, self.get_link_frame(0), ORIGIN, NO_ROTATION),
        ]

    def get_link_frame(self, link_index: int) -> str:
        """Return the frame name of a link."""
        return self._prefix + self._robot.links[link_index].name

    def get_optical_frame(self, kind: str, camera: str) -> str:
        """Return the frame name of a camera's images. `kind` is `depth` or `color`."""
        return f"{self._prefix}{make_ros_name(camera)}_{kind}_optical_frame"

    def get_mount_frame(self, sensor: str) -> str:
        """Return the frame name of a lidar, a range finder or a custom sensor."""
        return f"{self._prefix}{make_ros_name(sensor)}_frame"

    def get_imu_frame(self, link_index: int) -> str:
        """Return the frame name of the IMU on a link."""
        return f"{self.get_link_frame(link_index)}_imu_frame"

    def make_imu_transform(self, link_index: int) -> RosTransform:
        """Return the pose of an IMU, which sits in the middle of its link."""
        middle = (self._robot.links[link_index].length_m / 2, 0.0, 0.0)
        return RosTransform(
            self.get_link_frame(link_index), self.get_imu_frame(link_index), middle, NO_ROTATION
        )

    def make_base_transform(self, pose: WorldModel | Pose) -> RosTransform:
        """Return the pose of the base in `odom`."""
        if isinstance(pose, Pose):
            return RosTransform(self.odom, self.base, pose.position_w, pose.orientation_wxyz)
        return RosTransform(self.odom, self.base, pose.base_position_w, pose.base_orientation_wxyz)

    def make_joint_transforms(self, joints: JointState) -> list[RosTransform]:
        """Return the pose of each link in the link behind it, without the links whose joint state is not valid."""
        transforms: list[RosTransform] = []
        for i, joint in enumerate(self._robot.joints):
            if not joints.valid[i]:
                continue
            position = (self._robot.links[i].length_m, 0.0, 0.0)
            orientation = _make_joint_rotation(joint.axis, joints.angle_rad[i])
            transforms.append(
                RosTransform(
                    self.get_link_frame(i), self.get_link_frame(i + 1), position, orientation
                )
            )
        return transforms

    def make_camera_transforms(
        self, kind: str, camera: str, image: DepthImage | ColorImage
    ) -> list[RosTransform]:
        """Return the pose of a camera on its link, and of its optical frame in the camera frame."""
        optical_frame = self.get_optical_frame(kind, camera)
        camera_frame = optical_frame.replace("_optical_frame", "_frame")
        mount = RosTransform(
            self.get_link_frame(image.link),
            camera_frame,
            image.position_l,
            image.orientation_l_wxyz,
        )
        return [mount, RosTransform(camera_frame, optical_frame, ORIGIN, OPTICAL_IN_CAMERA)]

    def make_mount_transforms(self, sensor: str, sample: MountedSample) -> list[RosTransform]:
        """Return the pose of a sensor on its link, as its sample states it."""
        link_frame = self.get_link_frame(sample.link)
        return [
            RosTransform(
                link_frame,
                self.get_mount_frame(sensor),
                sample.position_l,
                sample.orientation_l_wxyz,
            )
        ]


def _make_joint_rotation(axis: str, angle_rad: float) -> Wxyz:
    """Return the rotation of a joint as a quaternion: yaw turns about z, pitch about y."""
    cos_half = math.cos(angle_rad / 2)
    sin_half = math.sin(angle_rad / 2)
    if axis == "yaw":
        return (cos_half, 0.0, 0.0, sin_half)
    return (cos_half, 0.0, sin_half, 0.0)

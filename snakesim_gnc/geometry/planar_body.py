"""The body model of controllers: a planar chain that bends at its yaw joints, computed once from the description."""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from statistics import median

import numpy as np

from snakesim_gnc.geometry.body_on_path import (
    PathBodyPose,
    compute_chain_points,
    compute_heading_rad,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_body_points_w
from snakesim_hal.model.geometry.route import compute_yaw_segments_m
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import RobotDescription, WorldModel

MAX_HISTORY_TICKS = 128  # of joint angles: more than the latency of any pose


class PlanarBody:
    """Lengths, limits and indices of a robot. Its body points are the tail end, the yaw joints, and the head end."""

    def __init__(self, robot: RobotDescription) -> None:
        """Derive from a description the lengths, limits and indices that planar computations use.

        Joints with another axis than yaw are rigid in the plane: the links on both sides of them are one segment.

        Args:
            robot: Description of the robot, whose joints and links are listed from tail to head.
        """
        axes = [joint.axis for joint in robot.joints]
        lengths = [link.length_m for link in robot.links]
        self._robot = robot

        # All joints and links.
        self.joint_names = [joint.name for joint in robot.joints]
        self.torque_limit_nm = [joint.torque_limit_nm for joint in robot.joints]
        self.radius_m = max(link.radius_m for link in robot.links)
        self.weight_n = GRAVITY_M_S2 * math.fsum(link.mass_kg for link in robot.links)
        self.joint_s_m = np.cumsum(lengths)[:-1]  # (n_joints,) along the body
        self._joint_s_m_list: list[float] = self.joint_s_m.tolist()

        # The joints that bend the body in the plane, and the segments between them.
        self.yaw_joints = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self._are_all_yaw_joints = len(self.yaw_joints) == len(axes)
        self.segments_m = compute_yaw_segments_m(axes, lengths)
        # Of neighboring joints that bend.
        self.spacing_m = median(self.segments_m[1:-1] or self.segments_m)
        self.body_points_s_m: list[float] = [0.0, *np.cumsum(self.segments_m).tolist()]
        self.length_m = self.body_points_s_m[-1]
        # Indices of the body points among the tail end (0), all joints (joint i is i + 1) and the head end.
        self._body_point_rows = [0, *(i + 1 for i in self.yaw_joints), len(lengths)]

    def expand_joint_angles(self, body_pose: PathBodyPose) -> Floats:
        """Return the angles of all joints, (n_joints,): those of the pose for yaw joints, and 0 for all others."""
        if self._are_all_yaw_joints:
            return body_pose.angles_rad
        angles_rad = np.zeros(len(self.joint_names))
        angles_rad[self.yaw_joints] = body_pose.angles_rad
        return angles_rad

    def compute_body_points_w(self, world: WorldModel, angles_rad: Sequence[float]) -> Floats:
        """Compute the points of the measured body on the ground.

        Args:
            world: World model with the pose of the base.
            angles_rad: Measured angles of all joints at the time of that pose, tail to head.

        Returns:
            (2, n_points) x and y of the tail end, the yaw joints and the head end, in m.
        """
        if not self._are_all_yaw_joints:
            # A link that is pitched up is shorter, as seen from above.
            chain_w = compute_body_points_w(
                self._robot, world.base_position_w, world.base_orientation_wxyz, angles_rad
            )
            return chain_w[self._body_point_rows, :2].T
        bend_angles_rad = [angles_rad[i] for i in self.yaw_joints]
        heading_rad = compute_heading_rad(world.base_orientation_wxyz)
        return compute_chain_points(
            world.base_position_w[:2], heading_rad, bend_angles_rad, self.segments_m
        )

    def compute_joint_positions_w(self, body_pose: PathBodyPose) -> Floats:
        """Compute the positions of all joints of a body on its path, (n_joints, 2) in m."""
        if self._are_all_yaw_joints:
            return body_pose.body_points_w[:, 1:-1].T
        node_x, node_y = body_pose.body_points_w
        x = np.interp(self.joint_s_m, self.body_points_s_m, node_x)
        y = np.interp(self.joint_s_m, self.body_points_s_m, node_y)
        return np.column_stack([x, y])

    def find_link_at(self, body_s_m: float) -> int:
        """Return the index of the link at an arc length along the body."""
        return bisect_right(self._joint_s_m_list, body_s_m)


class JointAngleHistory:
    """Stores the joint angles of the last ticks, for a pose that is some ticks old."""

    def __init__(self) -> None:
        self._entries: deque[tuple[int, list[float]]] = deque(maxlen=MAX_HISTORY_TICKS)

    def __bool__(self) -> bool:
        return bool(self._entries)

    def add(self, timestamp_ns: int, angles_rad: list[float]) -> None:
        """Store the angles of the newest joint state. A state that is not newer than the last one is ignored."""
        if not self._entries or timestamp_ns > self._entries[-1][0]:
            self._entries.append((timestamp_ns, angles_rad))

    def find_nearest(self, timestamp_ns: int) -> list[float]:
        """Return the joint angles that were measured at the time nearest to a timestamp.

        Of two measurements that are equally near, the older one is returned. The history must not be empty.
        """
        nearest_ns, nearest_rad = self._entries[-1]
        # From the newest on they come nearer, and then go away again. Poses are rarely older than a few ticks.
        for measured_ns, angles_rad in reversed(self._entries):
            if abs(measured_ns - timestamp_ns) > abs(nearest_ns - timestamp_ns):
                break
            nearest_ns = measured_ns
            nearest_rad = angles_rad
        return nearest_rad


def get_pose_time_ns(world: WorldModel) -> int:
    """Return when the body was at the world's base pose.

    A measured pose has the timestamp of the sensor. A dead-reckoned pose has that of the world model itself.
    """
    if world.pose_timestamp_ns is None or world.base_position_sd_m is not None:
        return world.timestamp_ns
    return world.pose_timestamp_ns

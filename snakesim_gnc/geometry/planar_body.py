"""The body model of controllers: a planar chain that bends at its yaw joints, computed once from the description."""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from statistics import median

import numpy as np

from snakesim_gnc.geometry.body_on_path import BodyPose, chain_nodes, compute_heading_rad
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import nodes_w
from snakesim_hal.model.route import yaw_segments_m
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import Description, World

TICKS_KEPT = 128


class PlanarBody:
    """Lengths, limits and indices. Nodes are the tail end, the joints that bend, and the head end."""

    def __init__(self, robot: Description) -> None:
        axes = [joint.axis for joint in robot.joints]
        lengths = [link.length_m for link in robot.links]
        self.names = [joint.name for joint in robot.joints]
        self.torque_limit_nm = [joint.torque_limit_nm for joint in robot.joints]
        self.radius_m = max(link.radius_m for link in robot.links)
        self.weight_n = GRAVITY_M_S2 * math.fsum(link.mass_kg for link in robot.links)
        self.bends = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self.segments_m = yaw_segments_m(axes, lengths)
        self.node_s_m: list[float] = [0.0, *np.cumsum(self.segments_m).tolist()]
        self.length_m = self.node_s_m[-1]
        self.spacing_m = median(self.segments_m[1:-1] or self.segments_m)  # of neighboring joints that bend
        self.joint_s_m = np.cumsum(lengths)[:-1]
        self._joint_s: list[float] = self.joint_s_m.tolist()
        self._all_bend = len(self.bends) == len(axes)
        self._robot, self._node_rows = robot, [0, *(i + 1 for i in self.bends), len(lengths)]

    def all_angles(self, body_pose: BodyPose) -> Floats:
        """Angles of all joints, (n_joints,): those that bend as on the path, the others straight."""
        if self._all_bend:
            return body_pose.angles_rad
        angles = np.zeros(len(self.names))
        angles[self.bends] = body_pose.angles_rad
        return angles

    def nodes_w(self, world: World, angles_rad: Sequence[float]) -> Floats:
        """Nodes (2, n_nodes) of the measured body; angles_rad: of all joints, at the instant of the world's pose."""
        if not self._all_bend:  # a link that is turned up is shorter, seen from above
            chain_w = nodes_w(self._robot, world.base_position_w, world.base_orientation_wxyz, angles_rad)
            return chain_w[self._node_rows, :2].T
        bending = [angles_rad[i] for i in self.bends]
        heading = compute_heading_rad(world.base_orientation_wxyz)
        return chain_nodes(world.base_position_w[:2], heading, bending, self.segments_m)

    def joints_w(self, body_pose: BodyPose) -> Floats:
        """Places of all joints on the path, (n_joints, 2)."""
        x, y = body_pose.nodes_w
        if self._all_bend:
            return body_pose.nodes_w[:, 1:-1].T
        return np.column_stack([np.interp(self.joint_s_m, self.node_s_m, values) for values in (x, y)])

    def link_at(self, body_s_m: float) -> int:
        """Index of the link at an arc length along the body."""
        return bisect_right(self._joint_s, body_s_m)


class RecentAngles:
    """Joint angles of the last ticks, for a pose that is some ticks old."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, list[float]]] = deque(maxlen=TICKS_KEPT)

    def __bool__(self) -> bool:
        return bool(self._kept)

    def add(self, timestamp_ns: int, angles_rad: list[float]) -> None:
        """Those of the newest joint state, which may be the one before again."""
        if not self._kept or timestamp_ns > self._kept[-1][0]:
            self._kept.append((timestamp_ns, angles_rad))

    def nearest_to(self, timestamp_ns: int) -> list[float]:
        """Those measured nearest to an instant."""
        return min(self._kept, key=lambda held: abs(held[0] - timestamp_ns))[1]


def pose_instant_ns(world: World) -> int:
    """When the body was at the world's base pose: that of the sensor, or dead-reckoned up to the world's own stamp."""
    if world.pose_timestamp_ns is None or world.base_position_sd_m is not None:
        return world.timestamp_ns
    return world.pose_timestamp_ns

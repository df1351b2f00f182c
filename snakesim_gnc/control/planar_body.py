"""The body model of controllers: a planar chain that bends at its yaw joints, computed once from the description."""

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.body_on_path import BodyPose
from snakesim_hal.model.route import yaw_segments_m
from snakesim_hal.wire.messages import Description

Floats = NDArray[np.float64]

GRAVITY_M_S2 = 9.81


class PlanarBody:
    """Lengths, limits and indices. Nodes are the tail end, the joints that bend, and the head end."""

    def __init__(self, robot: Description) -> None:
        axes = [joint.axis for joint in robot.joints]
        lengths = [link.length_m for link in robot.links]
        self.names = [joint.name for joint in robot.joints]
        self.torque_limit_nm = [joint.torque_limit_nm for joint in robot.joints]
        self.radius_m = max(link.radius_m for link in robot.links)
        self.weight_n = GRAVITY_M_S2 * sum(link.mass_kg for link in robot.links)
        self.bends = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self.segments_m = yaw_segments_m(axes, lengths)
        self.node_s_m: list[float] = [0.0, *np.cumsum(self.segments_m).tolist()]
        self.length_m = self.node_s_m[-1]
        self.joint_s_m = np.cumsum(lengths)[:-1]
        self._joint_s: list[float] = self.joint_s_m.tolist()
        self._all_bend = len(self.bends) == len(axes)

    def all_angles(self, body_pose: BodyPose) -> Floats:
        """Angles of all joints, (n_joints,): those that bend as on the path, the others straight."""
        if self._all_bend:
            return body_pose.angles_rad
        angles = np.zeros(len(self.names))
        angles[self.bends] = body_pose.angles_rad
        return angles

    def joints_w(self, body_pose: BodyPose) -> Floats:
        """Places of all joints on the path, (n_joints, 2)."""
        x, y = body_pose.nodes_w
        if self._all_bend:
            return body_pose.nodes_w[:, 1:-1].T
        return np.column_stack([np.interp(self.joint_s_m, self.node_s_m, values) for values in (x, y)])

    def link_at(self, body_s_m: float) -> int:
        """Index of the link at an arc length along the body."""
        return bisect_right(self._joint_s, body_s_m)

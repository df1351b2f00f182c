"""Bends the pitch joints of a body whose path leads over platforms.

The path gets a height over its arc length: the highest of all platforms' tops, with a ramp before and behind each.
Every joint bends as that line does where the joint is, so that the shape stays in its place in the world while the body
slides through it: the head is lifted before the edge, each link follows it, and the tail comes down last. Links are
straight, and servos give way under the weight of what they lift, so the line is a little higher than the top.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import PathRise, RobotDescription

MAX_SLOPE = 0.35  # height over length of a ramp
CLEARANCE_M = 0.02  # height of the line over the top of a platform


def compute_path_height_m(rises: Sequence[PathRise], s_m: float) -> float:
    """Return the height of the path above the ground at an arc length.

    With the height h_i of each platform and the distance d_i to it along the path, it is
    max(0, max_i (h_i + CLEARANCE_M - MAX_SLOPE d_i)).
    """
    height_m = 0.0
    for rise in rises:
        distance_m = max(rise.from_s_m - s_m, s_m - rise.to_s_m, 0.0)
        height_m = max(height_m, rise.height_m + CLEARANCE_M - MAX_SLOPE * distance_m)
    return height_m


class PlatformClimb:
    """Computes the pitch angles of one robot."""

    def __init__(self, robot: RobotDescription) -> None:
        joint_s_m = np.cumsum([link.length_m for link in robot.links])
        self._joint_count = len(robot.joints)
        self._pitch_joints = [i for i, joint in enumerate(robot.joints) if joint.axis == "pitch"]

        # Arc lengths of the tail end, the pitch joints and the head end on the body.
        self._bend_points_s_m = np.concatenate(
            ([0.0], joint_s_m[self._pitch_joints], joint_s_m[-1:])
        )

    def compute_pitch_angles_rad(self, rises: list[PathRise], tail_s_m: float) -> Floats:
        """Compute the pitch angles with which the body follows the height of its path over platforms.

        Between two pitch joints at the line's heights z_i and z_{i+1}, a distance l_i apart, the body has the slope
        arcsin((z_{i+1} - z_i) / l_i). The angle of a pitch joint is the negative difference of the slopes at it.

        Args:
            rises: Platforms along the path.
            tail_s_m: Arc length of the tail end on the path.

        Returns:
            (n_joints,) angles of all joints in rad, tail to head; positive angles bend down. Those of yaw joints are 0.
        """
        angles_rad = np.zeros(self._joint_count)
        if not rises or not self._pitch_joints:
            return angles_rad
        heights_m = np.array(
            [compute_path_height_m(rises, tail_s_m + s_m) for s_m in self._bend_points_s_m]
        )
        sines = np.clip(np.diff(heights_m) / np.diff(self._bend_points_s_m), -1.0, 1.0)
        slopes_rad = np.arcsin(sines)
        angles_rad[self._pitch_joints] = -np.diff(slopes_rad)
        return angles_rad

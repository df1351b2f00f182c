"""The joints that turn up and down, of a body whose path leads over platforms. Pure.

The path gets a height over its arc length: the highest of all platforms' tops, with a ramp before and behind each.
Every joint takes the bend of that line where it is, so the shape stays in its place in the world while the body slides
on through it: the head is lifted before the edge, each link follows it, and the tail comes down last. Links are
straight and servos give way under the weight of what they lift, so the line is a little higher than the top.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description, Rise

STEEPEST = 0.35  # of a ramp: height over length
ABOVE_M = 0.02  # of the line over a platform's top


def line_height_m(rises: Sequence[Rise], s_m: float) -> float:
    """Of the path at an arc length, above the ground."""
    height_m = 0.0
    for rise in rises:
        off_m = max(rise.from_s_m - s_m, s_m - rise.to_s_m, 0.0)
        height_m = max(height_m, rise.height_m + ABOVE_M - STEEPEST * off_m)
    return height_m


class Climb:
    """Of one robot."""

    def __init__(self, robot: Description) -> None:
        joints_s_m = np.cumsum([link.length_m for link in robot.links])
        self._pitches = [i for i, joint in enumerate(robot.joints) if joint.axis == "pitch"]
        self._nodes_s_m = np.concatenate(([0.0], joints_s_m[self._pitches], joints_s_m[-1:]))
        self._count = len(robot.joints)

    def angles_rad(self, rises: list[Rise], tail_s_m: float) -> Floats:
        """Angles of all joints, (n_joints,), with the tail at an arc length: 0 of those that turn left and right."""
        angles = np.zeros(self._count)
        if rises and self._pitches:
            line_m = np.array([line_height_m(rises, tail_s_m + s_m) for s_m in self._nodes_s_m])
            slopes_rad = np.arcsin(np.clip(np.diff(line_m) / np.diff(self._nodes_s_m), -1.0, 1.0))
            angles[self._pitches] = -np.diff(slopes_rad)  # down is positive
        return angles

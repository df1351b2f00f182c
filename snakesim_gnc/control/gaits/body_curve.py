"""The joint angles of any robot on a curve, so that parameters of the curve transfer between robots.

A curve is given by its heading: the angle of its tangent at each fraction of the body length, counted from the head.
Every straight piece of the body gets the heading of the curve at its middle. The angle of a joint is the difference of
the headings of the two pieces at it:

    angle_i = psi(middle of the piece ahead of joint i) - psi(middle of the piece behind joint i)

Lengths are fractions of the body length, so that the number of joints and their spacing do not appear in a gait.
"""

import math

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import Axis, Description

DIRECTIONS: dict[Axis, str] = {"pitch": "up and down", "yaw": "left and right"}  # of a joint, by its axis
MIN_JOINTS_PER_WAVE = 3.0  # with fewer, the body is far from the curve
PHASES = np.linspace(0.0, math.tau, 32, endpoint=False)  # rad, at which angle limits are checked


class BodyCurve:
    """The joints of a robot that bend in one plane, and the straight pieces between them."""

    def __init__(self, robot: Description, axis: Axis) -> None:
        """Measure the pieces.

        Args:
            robot: description of the robot.
            axis: axis of the joints that bend: yaw in the ground plane, pitch in the vertical plane.
        """
        ends_m = np.cumsum([link.length_m for link in robot.links])  # of the links, from the tail end
        self.joints = [i for i, joint in enumerate(robot.joints) if joint.axis == axis]
        self.length_m = float(ends_m[-1])
        self._robot = robot
        self._axis: Axis = axis
        self._joint_count = len(robot.joints)
        self._sign = -1.0 if axis == "pitch" else 1.0  # a positive pitch angle bends down

        nodes_m = np.concatenate(([0.0], ends_m[self.joints], ends_m[-1:]))
        middles_m = 0.5 * (nodes_m[:-1] + nodes_m[1:])
        self.from_head = 1.0 - middles_m / self.length_m
        """Fractions of the body length between the head end and the middle of each piece, tail to head."""

    def find_angles_rad(self, headings_rad: Floats) -> Floats:
        """Return the angles of all joints, (n_joints,); joints with the other axis are straight.

        Args:
            headings_rad: (n_pieces,) of the curve at `from_head`; to the left or upward is positive.
        """
        angles_rad = np.zeros(self._joint_count)
        angles_rad[self.joints] = self._sign * np.diff(headings_rad)
        return angles_rad

    def spread_bend(self, bend_rad: float) -> Floats:
        """Return headings of a curve that turns by an angle in all, at an even curvature, (n_pieces,)."""
        return bend_rad * (0.5 - self.from_head)

    def check_wavelength(self, wavelength: float, setting: str, remedy: str) -> None:
        """Check that the joints are dense enough for a wave.

        Args:
            wavelength: as a fraction of the body length.
            setting: what makes this wave, for the error, such as "control.wavelength of 0.2".
            remedy: what to change, for the error.

        Raises:
            ConfigError: the body has fewer than MIN_JOINTS_PER_WAVE joints in a wave.
        """
        if not self.joints:
            return
        min_wavelength = MIN_JOINTS_PER_WAVE / len(self.joints)
        if wavelength < min_wavelength - 1e-9:
            raise ConfigError(
                f"{setting} makes waves of {wavelength:.3g} body lengths in the joints that turn "
                f"{DIRECTIONS[self._axis]}. This robot has {len(self.joints)} of them, which form waves of at least "
                f"{min_wavelength:.3g} body lengths: {remedy}",
                code="python/invalid-argument",
            )

    def check_limits(self, angles_rad: Floats, setting: str) -> None:
        """Check that no joint has to turn beyond its limits.

        Args:
            angles_rad: (n_shapes, n_joints) of the gait.
            setting: what makes these angles, for the error, such as "control.slope_rad of 0.4 rad".

        Raises:
            ConfigError: an angle is beyond the limit of its joint.
        """
        peaks_rad = np.abs(angles_rad).max(axis=0)
        for joint, peak_rad in zip(self._robot.joints, peaks_rad, strict=True):
            limit_rad = min(-joint.angle_min_rad, joint.angle_max_rad)
            if peak_rad > limit_rad:
                raise ConfigError(
                    f"{setting} turns {joint.name} by {peak_rad:.3g} rad. Its limit is {limit_rad:.3g} rad: reduce "
                    "this parameter, or make the waves longer",
                    code="python/invalid-argument",
                )

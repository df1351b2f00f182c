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
from snakesim_hal.wire.messages import Axis, RobotDescription

# Of a joint, by its axis.
DIRECTIONS: dict[Axis, str] = {"pitch": "up and down", "yaw": "left and right"}
MIN_JOINTS_PER_WAVE = 3.0  # with fewer, the body is far from the curve
# Rad, at which angle limits are checked.
CHECKED_PHASES_RAD = np.linspace(0.0, math.tau, 32, endpoint=False)


class BodyCurve:
    """The joints of a robot that bend in one plane, and the straight pieces between them."""

    def __init__(self, robot: RobotDescription, axis: Axis) -> None:
        """Compute the lengths of the straight pieces of the body between the joints with one axis.

        Args:
            robot: Description of the robot.
            axis: Axis of the joints that bend: yaw in the ground plane, pitch in the vertical plane.
        """
        # Of the links, from the tail end.
        ends_m = np.cumsum([link.length_m for link in robot.links])
        self.joint_indices = [i for i, joint in enumerate(robot.joints) if joint.axis == axis]
        self.length_m = float(ends_m[-1])
        self._robot = robot
        self._axis: Axis = axis
        self._joint_count = len(robot.joints)
        self._sign = -1.0 if axis == "pitch" else 1.0  # a positive pitch angle bends down

        nodes_m = np.concatenate(([0.0], ends_m[self.joint_indices], ends_m[-1:]))
        middles_m = 0.5 * (nodes_m[:-1] + nodes_m[1:])
        self.head_distance_fractions = 1.0 - middles_m / self.length_m
        """Fractions of the body length between the head end and the middle of each piece, tail to head."""

    def compute_joint_angles_rad(self, headings_rad: Floats) -> Floats:
        """Compute the joint angles with which the body follows a curve.

        Args:
            headings_rad: (n_pieces,) headings of the curve at `head_distance_fractions`; left or upward is positive.

        Returns:
            (n_joints,) angles of all joints; those of joints with the other axis are 0.
        """
        angles_rad = np.zeros(self._joint_count)
        angles_rad[self.joint_indices] = self._sign * np.diff(headings_rad)
        return angles_rad

    def make_bend_headings_rad(self, bend_rad: float) -> Floats:
        """Return the headings, (n_pieces,), of an arc that turns by an angle over the whole body length."""
        return bend_rad * (0.5 - self.head_distance_fractions)

    def check_wavelength(self, wavelength: float, parameter_label: str, remedy: str) -> None:
        """Check that the body has enough joints for each wave.

        Args:
            wavelength: Length of a wave, as a fraction of the body length.
            parameter_label: Name and value of the parameter that makes this wave, for the error message, such as
                "control.wavelength of 0.2".
            remedy: What the user should do, for the error message, such as "increase it".

        Raises:
            ConfigError: The body has fewer than MIN_JOINTS_PER_WAVE joints in a wave.
        """
        if not self.joint_indices:
            return
        min_wavelength = MIN_JOINTS_PER_WAVE / len(self.joint_indices)
        if wavelength < min_wavelength - 1e-9:
            raise ConfigError(
                f"{parameter_label} makes waves of {wavelength:.3g} body lengths in the joints that turn "
                f"{DIRECTIONS[self._axis]}. This robot has {len(self.joint_indices)} of them, which form waves of at "
                f"least {min_wavelength:.3g} body lengths: {remedy}",
                code="python/invalid-argument",
            )

    def check_limits(self, angles_rad: Floats, parameter_label: str) -> None:
        """Check that no joint has to turn beyond its limits.

        Args:
            angles_rad: (n_shapes, n_joints) joint angles of the gait at several phases.
            parameter_label: Name and value of the parameter that makes these angles, for the error message, such as
                "control.slope_rad of 0.4 rad".

        Raises:
            ConfigError: An angle is beyond the limit of its joint.
        """
        peaks_rad = np.abs(angles_rad).max(axis=0)
        for joint, peak_rad in zip(self._robot.joints, peaks_rad, strict=True):
            limit_rad = min(-joint.angle_min_rad, joint.angle_max_rad)
            if peak_rad > limit_rad:
                raise ConfigError(
                    f"{parameter_label} turns {joint.name} by {peak_rad:.3g} rad. Its limit is {limit_rad:.3g} rad: "
                    "reduce this parameter, or make the waves longer",
                    code="python/invalid-argument",
                )

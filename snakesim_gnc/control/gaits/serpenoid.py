"""The serpenoid curve of Hirose, steered along the path by the directional control of Liljebäck.

Source of the curve: S. Hirose, "Biologically Inspired Robots: Snake-Like Locomotors and Manipulators", Oxford
University Press 1993. The heading of the curve is a cosine of the arc length. With the winding angle alpha, the
wavelength lambda as a fraction of the body length, and the fraction sigma of the body behind the head end,

    psi(sigma, t) = alpha cos(omega t - 2 pi sigma / lambda).

The wave travels from the head to the tail. Equal links of the length l (as a fraction of the body) then have the joint
angles of the usual discrete form, phi_i = A sin(omega t - i delta + const), with A = 2 alpha sin(delta / 2) and
delta = 2 pi l / lambda. Source of the directional control: see `heading_control`.
"""

import math
from typing import Annotated

import numpy as np

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, Seconds
from snakesim_gnc.control.gaits.body_curve import CHECKED_PHASES_RAD, BodyCurve
from snakesim_gnc.control.gaits.heading_control import (
    HeadingControl,
    LookAhead,
    MaxBend,
    SteeringGain,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded, from_zero

WindingAngle = Annotated[float, from_zero(2.2, "rad")]
Wavelength = Annotated[float, bounded(0.1, 10, "body lengths")]


class SerpenoidParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the curve, which transfer between robots, and of the directional control."""

    winding_angle_rad: WindingAngle = 0.9
    """Angle between the curve's axis and its steepest tangent (alpha)."""

    wavelength: Wavelength = 0.8
    """Length of a wave along the body (lambda)."""

    period_s: Seconds = 1.6
    """Period of the wave."""

    k_theta: SteeringGain = 2.0
    """Bend of the whole body for each radian of heading error; 0: no directional control."""

    look_ahead: LookAhead = 1.0
    """Look-ahead distance of the line-of-sight guidance (Delta)."""

    max_bend_rad: MaxBend = 1.5
    """Maximum bend of the whole body by the directional control."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


def compute_serpenoid_headings(
    from_head: Floats, phase_rad: float, winding_angle_rad: float, wavelength: float
) -> Floats:
    """Return the headings psi of the serpenoid curve.

    Args:
        from_head: (n,) sigma, fractions of the body length behind the head end.
        phase_rad: omega t.
        winding_angle_rad: alpha.
        wavelength: lambda, as a fraction of the body length.

    Returns:
        (n,) rad.
    """
    return winding_angle_rad * np.cos(phase_rad - math.tau * from_head / wavelength)


def check_serpenoid(robot: RobotDescription, winding_angle_rad: float, wavelength: float) -> None:
    """Check that the yaw joints of a robot can form the serpenoid curve at every phase.

    Args:
        robot: The robot.
        winding_angle_rad: alpha, the parameter `winding_angle_rad` of the controller.
        wavelength: lambda, the parameter `wavelength` of the controller.

    Raises:
        ConfigError: The waves are too short for the joints, or the bends exceed their limits.
    """
    curve = BodyCurve(robot, "yaw")
    curve.check_wavelength(wavelength, f"control.wavelength of {wavelength:g}", "increase it")
    shapes_rad = [
        curve.compute_joint_angles_rad(
            compute_serpenoid_headings(
                curve.head_distance_fractions, phase_rad, winding_angle_rad, wavelength
            )
        )
        for phase_rad in CHECKED_PHASES_RAD
    ]
    curve.check_limits(
        np.array(shapes_rad), f"control.winding_angle_rad of {winding_angle_rad:g} rad"
    )


class Serpenoid(Gait[SerpenoidParameters]):
    """Moves forward on ground on which links slide more easily along the body than sideways, and among push-points."""

    Parameters = SerpenoidParameters
    _required_axes = ("yaw",)

    @classmethod
    def check(cls, robot: RobotDescription, parameters: SerpenoidParameters) -> None:
        """Check that the joints can form the curve. Raises ConfigError."""
        check_serpenoid(robot, parameters.winding_angle_rad, parameters.wavelength)

    def __init__(self, robot: RobotDescription, parameters: SerpenoidParameters) -> None:
        super().__init__(robot, parameters)
        self._curve = BodyCurve(robot, "yaw")
        self._heading_control = HeadingControl(
            robot,
            k_theta=parameters.k_theta,
            look_ahead=parameters.look_ahead,
            max_bend_rad=parameters.max_bend_rad,
            time_constant_s=parameters.period_s,
        )

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        headings_rad = compute_serpenoid_headings(
            self._curve.head_distance_fractions,
            phase_rad,
            self.parameters.winding_angle_rad,
            self.parameters.wavelength,
        )
        bend_rad = self._heading_control.compute_bend_rad(observation)
        return self._curve.compute_joint_angles_rad(
            headings_rad + self._curve.make_bend_headings_rad(bend_rad)
        )

    def list_custom_telemetry(self) -> dict[str, float]:
        return {"heading_error_rad": self._heading_control.error_rad}

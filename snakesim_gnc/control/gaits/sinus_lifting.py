"""Sinus-lifting: a serpenoid curve in the ground plane whose bends are lifted, so that only its straight parts rest.

Source: S. Hirose, "Biologically Inspired Robots", Oxford University Press 1993, for the motion of snakes; R. Ariizumi,
F. Matsuno, "Dynamic Analysis of Three Snake Robot Gaits", IEEE Transactions on Robotics 33 (2017), which compares it
with sidewinding and lateral undulation. In the ground plane the heading is that of the serpenoid curve,

    psi_yaw(sigma, t) = alpha cos(u),   u = omega t - 2 pi sigma / lambda.

The curvature of this curve is proportional to sin(u). The height is largest where the bend is sharpest, and zero in the
straight parts between two bends, z = H sin(u)^2. Its slope along the body, with beta = 2 pi H / (lambda L), is

    psi_pitch(sigma, t) = beta sin(2 u).

The height as a function of u is ours: the authors above choose which links touch the ground.
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
from snakesim_gnc.control.gaits.serpenoid import (
    Wavelength,
    WindingAngle,
    compute_serpenoid_headings,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded


class SinusLiftingParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the curve, which transfer between robots, and of the directional control."""

    winding_angle_rad: WindingAngle = 1.0
    """Angle between the curve's axis and its steepest tangent, in the ground plane (alpha)."""

    wavelength: Wavelength = 0.7
    """Length of a wave along the body (lambda). The wave of the height is half as long."""

    lift_slope_rad: Annotated[float, bounded(-1, 1, "rad")] = 0.05
    """Steepest slope of the lifted parts (beta); negative: the straight parts are lifted instead."""

    period_s: Seconds = 1.5
    """Period of the wave."""

    k_theta: SteeringGain = 0.0
    """Bend of the whole body for each radian of heading error; 0: no directional control."""

    look_ahead: LookAhead = 1.0
    """Look-ahead distance of the line-of-sight guidance (Delta)."""

    max_bend_rad: MaxBend = 1.0
    """Maximum bend of the whole body by the directional control."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class SinusLifting(Gait[SinusLiftingParameters]):
    """Moves forward on level ground, also if its friction is isotropic. It needs yaw and pitch joints."""

    Parameters = SinusLiftingParameters
    _required_axes = ("pitch", "yaw")

    @classmethod
    def check(cls, robot: RobotDescription, parameters: SinusLiftingParameters) -> None:
        """Check that the joints can form the curve. Raises ConfigError."""
        curves = (BodyCurve(robot, "yaw"), BodyCurve(robot, "pitch"))
        yaw_curve, pitch_curve = curves
        parameter_label = f"control.wavelength of {parameters.wavelength:g}"
        yaw_curve.check_wavelength(parameters.wavelength, parameter_label, "increase it")
        pitch_curve.check_wavelength(0.5 * parameters.wavelength, parameter_label, "increase it")
        if yaw_curve.joint_indices and pitch_curve.joint_indices:
            shapes_rad = np.array(
                [
                    _compute_angles_rad(curves, parameters, phase, 0.0)
                    for phase in CHECKED_PHASES_RAD
                ]
            )
            yaw_curve.check_limits(
                shapes_rad, f"control.winding_angle_rad of {parameters.winding_angle_rad:g} rad"
            )

    def __init__(self, robot: RobotDescription, parameters: SinusLiftingParameters) -> None:
        super().__init__(robot, parameters)
        self._curves = (BodyCurve(robot, "yaw"), BodyCurve(robot, "pitch"))
        self._heading_control = HeadingControl(
            robot,
            k_theta=parameters.k_theta,
            look_ahead=parameters.look_ahead,
            max_bend_rad=parameters.max_bend_rad,
            time_constant_s=parameters.period_s,
        )

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        bend_rad = self._heading_control.compute_bend_rad(observation)
        return _compute_angles_rad(self._curves, self.parameters, phase_rad, bend_rad)


def _compute_angles_rad(
    curves: tuple[BodyCurve, BodyCurve],
    parameters: SinusLiftingParameters,
    phase_rad: float,
    bend_rad: float,
) -> Floats:
    yaw_curve, pitch_curve = curves
    headings_rad = compute_serpenoid_headings(
        yaw_curve.head_distance_fractions,
        phase_rad,
        parameters.winding_angle_rad,
        parameters.wavelength,
    )
    u = phase_rad - math.tau * pitch_curve.head_distance_fractions / parameters.wavelength
    slopes_rad = parameters.lift_slope_rad * np.sin(2.0 * u)
    yaw_rad = yaw_curve.compute_joint_angles_rad(
        headings_rad + yaw_curve.make_bend_headings_rad(bend_rad)
    )
    return yaw_rad + pitch_curve.compute_joint_angles_rad(slopes_rad)

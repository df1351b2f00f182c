"""Rectilinear motion: a wave of the pitch joints travels from the tail to the head and carries a straight body forward.

Source: M. Tesch, K. Lipkin, I. Brown, R. Hatton, A. Peck, J. Rembisz, H. Choset, "Parameterized and Scripted Gaits for
Modular Snake Robots", Advanced Robotics 23 (2009), for linear progression of robots; H. Marvi, J. Bridges, D. L. Hu,
"Snakes mimic earthworms: propulsion using rectilinear travelling waves", Journal of the Royal Society Interface 10
(2013), for snakes, which do it by their skin. The slope of the body is

    psi(sigma, t) = beta cos(omega t + 2 pi sigma / lambda).

The body rests on the troughs of the wave. If those do not slip, the body advances by its shortening in each period,
lambda L (1 / J_0(beta) - 1), about lambda L beta^2 / 4. A round body that is straight rolls over, so its yaw joints lie
in a curve that does not change,

    psi_yaw(sigma) = stance sin(2 pi sigma).
"""

import math
from typing import Annotated

import numpy as np

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, Seconds
from snakesim_gnc.control.gaits.body_curve import CHECKED_PHASES_RAD, BodyCurve
from snakesim_gnc.control.gaits.serpenoid import Wavelength
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import from_zero


class RectilinearParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the wave, which transfer between robots."""

    slope_rad: Annotated[float, from_zero(1.2, "rad")] = 0.3
    """Steepest slope of the body (beta)."""

    wavelength: Wavelength = 0.45
    """Length of a wave along the body (lambda)."""

    stance_rad: Annotated[float, from_zero(1.5, "rad")] = 0.9
    """Largest angle between the body and its axis in the ground plane; 0: straight, and likely to roll over."""

    period_s: Seconds = 0.8
    """Period of the wave."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class Rectilinear(Gait[RectilinearParameters]):
    """Moves forward without a sideways motion of the body. It needs pitch joints, and ground that holds the troughs."""

    Parameters = RectilinearParameters
    _required_axes = ("pitch", "yaw")

    @classmethod
    def check(cls, robot: RobotDescription, parameters: RectilinearParameters) -> None:
        """Check that the joints can form the wave. Raises ConfigError."""
        curve = BodyCurve(robot, "pitch")
        curve.check_wavelength(
            parameters.wavelength, f"control.wavelength of {parameters.wavelength:g}", "increase it"
        )
        shapes_rad = np.array(
            [_compute_slope_angles_rad(curve, parameters, phase) for phase in CHECKED_PHASES_RAD]
        )
        curve.check_limits(shapes_rad, f"control.slope_rad of {parameters.slope_rad:g} rad")

    def __init__(self, robot: RobotDescription, parameters: RectilinearParameters) -> None:
        super().__init__(robot, parameters)
        self._pitch_curve = BodyCurve(robot, "pitch")
        yaw_curve = BodyCurve(robot, "yaw")
        self._stance_rad = yaw_curve.compute_joint_angles_rad(
            parameters.stance_rad * np.sin(math.tau * yaw_curve.head_distance_fractions)
        )

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        return self._stance_rad + _compute_slope_angles_rad(
            self._pitch_curve, self.parameters, phase_rad
        )


def _compute_slope_angles_rad(
    curve: BodyCurve, parameters: RectilinearParameters, phase_rad: float
) -> Floats:
    slopes_rad = parameters.slope_rad * np.cos(
        phase_rad + math.tau * curve.head_distance_fractions / parameters.wavelength
    )
    return curve.compute_joint_angles_rad(slopes_rad)

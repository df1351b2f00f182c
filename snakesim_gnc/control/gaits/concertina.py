"""Concertina: one half of the body is folded and holds, while the other half extends or is drawn in.

Source: J. Gray, "The mechanism of locomotion in snakes", Journal of Experimental Biology 23 (1946), which describes the
gait; H. Marvi, D. L. Hu, "Friction enhancement in concertina locomotion of snakes", Journal of the Royal Society
Interface 9 (2012), which measures it in channels. The curve and its schedule are ours: each half of the body, with the
fraction x of its length, has the heading

    psi(x, t) = alpha sqrt(u(t)) sin(2 pi m x),

with m folds. A half of the length l is shortened by l (1 - J_0(alpha sqrt(u))), nearly in proportion to u. With u_f of
the front half and u_r of the rear half, a cycle has three steps of equal time:

    transfer   u_f rises from 0 to 1, u_r = 1 - u_f    the middle of the body moves forward, both ends hold
    draw       u_f = 1, u_r rises from 0 to 1          the front half holds, and the tail is drawn in
    extend     u_f falls from 1 to 0, u_r = 1          the rear half holds, and the head extends
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, Seconds
from snakesim_gnc.control.gaits.body_curve import CHECKED_PHASES_RAD, BodyCurve
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import from_zero


class ConcertinaParameters(GaitParameters, frozen=True, kw_only=True):
    """Parameters of the folds, which transfer between robots."""

    winding_angle_rad: Annotated[float, from_zero(1.5, "rad")] = 1.0
    """Angle between the curve's axis and its steepest tangent, where the body is folded (alpha)."""

    folds: Annotated[int, Meta(ge=1, le=10, extra_json_schema={"unit": "1"})] = 1
    """Number of waves in each half of the body (m)."""

    period_s: Seconds = 3.0
    """Time of a cycle: transfer, draw, extend."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


def compute_fold_fractions(phase_rad: float) -> tuple[float, float]:
    """Return u_f and u_r, 0 for an extended half to 1 for a folded one, at a phase of the cycle."""
    cycle_step = 3.0 * (phase_rad / math.tau % 1.0)
    rising_fraction = 0.5 - 0.5 * math.cos(math.pi * (cycle_step % 1.0))
    if cycle_step < 1.0:
        return rising_fraction, 1.0 - rising_fraction
    if cycle_step < 2.0:
        return 1.0, rising_fraction
    return 1.0 - rising_fraction, 1.0


class Concertina(Gait[ConcertinaParameters]):
    """Moves forward in a channel whose walls the folds touch. It is slow, and holds at any time."""

    Parameters = ConcertinaParameters
    _required_axes = ("yaw",)

    @classmethod
    def check(cls, robot: RobotDescription, parameters: ConcertinaParameters) -> None:
        """Check that the joints can form the folds. Raises ConfigError."""
        curve = BodyCurve(robot, "yaw")
        curve.check_wavelength(
            0.5 / parameters.folds, f"control.folds of {parameters.folds}", "reduce it"
        )
        shapes_rad = np.array(
            [_compute_angles_rad(curve, parameters, phase) for phase in CHECKED_PHASES_RAD]
        )
        curve.check_limits(
            shapes_rad, f"control.winding_angle_rad of {parameters.winding_angle_rad:g} rad"
        )

    def __init__(self, robot: RobotDescription, parameters: ConcertinaParameters) -> None:
        super().__init__(robot, parameters)
        self._curve = BodyCurve(robot, "yaw")

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        return _compute_angles_rad(self._curve, self.parameters, phase_rad)


def _compute_angles_rad(
    curve: BodyCurve, parameters: ConcertinaParameters, phase_rad: float
) -> Floats:
    front, rear = compute_fold_fractions(phase_rad)
    fold_fractions = np.where(curve.head_distance_fractions < 0.5, front, rear)
    waves = np.sin(math.tau * parameters.folds * 2.0 * curve.head_distance_fractions)
    return curve.compute_joint_angles_rad(
        parameters.winding_angle_rad * np.sqrt(fold_fractions) * waves
    )

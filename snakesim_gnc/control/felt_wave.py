"""A wave whose joints yield to, and join in with, what they and their neighbours measure. Needs no map and no contacts.

    target = (amplitude + growth share) sin(phase - lag turns) + bend + FELT_RAD tanh(sum of gains x measured)

turns counts the joints that bend from the head on, share goes from 0 at the head to 1 at the tail. It is the law of the
shipped policy `clutter` (`snakesim train`, `docs/environments.md`) with its numbers, but for the gains on contact
forces, and with the bend of `HeadSteeredUndulation`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.undulation import HeadSteeredUndulation
from snakesim_hal.wire.messages import Description

AMPLITUDE_RAD, GROWTH_RAD, PERIOD_S, LAG_RAD = 0.565567, -0.54787, math.tau / 5.541805, 0.40975
FELT_RAD = 0.4
# Of the joint behind, of the joint itself and of the one ahead.
ANGLE_GAINS = np.array([-0.887897, 0.100268, 0.126671]) / 0.5  # 1/rad
VELOCITY_GAINS = np.array([-0.064773, 0.086698, 0.383481]) / 2.0  # s/rad
TORQUE_GAINS = np.array([0.673059, -0.464064, -0.666265]) / 5.0  # 1/(N m)


class FeltWave(HeadSteeredUndulation):
    """A wave bent towards where the path leads, largest at the head, that feels its way."""

    def __init__(self, robot: Description) -> None:
        wave = HeadSteeredUndulation.Settings(amplitude_rad=AMPLITUDE_RAD, period_s=PERIOD_S, lag_rad=LAG_RAD)
        super().__init__(robot, wave)
        count = len(self._body.bends)
        self._swing_rad = AMPLITUDE_RAD + GROWTH_RAD * np.arange(count)[::-1] / max(count - 1, 1)

    def reference_rad(self, view: View, passed_s: float) -> NDArray[np.float64]:
        """Angles of all joints, a time later than before."""
        reference, bends, joints = super().reference_rad(view, passed_s), self._body.bends, view.joints
        felt = np.zeros(len(bends))
        for measured, gains in (
            (joints.angle_rad, ANGLE_GAINS),
            (joints.velocity_rad_s, VELOCITY_GAINS),
            (joints.torque_nm, TORQUE_GAINS),
        ):
            beside = np.pad(np.array(measured)[bends], 1)
            felt += gains[0] * beside[:-2] + gains[1] * beside[1:-1] + gains[2] * beside[2:]
        reference[bends] += FELT_RAD * np.tanh(felt)
        return reference

    def _amplitude_rad(self, _view: View, _waves: NDArray[np.float64], _passed_s: float) -> NDArray[np.float64]:
        return self._swing_rad

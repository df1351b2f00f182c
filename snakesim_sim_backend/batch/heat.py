"""Winding temperatures of the motors of many robots: `ThermalModel` on arrays of shape (robots, joints)."""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.physics.thermal import MIN_TORQUE_FRACTION


class HeatArrays:
    """The temperatures, and the curves by which hot motors are derated.

    Attributes:
        winding_c: (robots, joints), the temperatures.
    """

    def __init__(self, robot_count: int, joint_count: int, period_s: float) -> None:
        shape = (robot_count, joint_count)
        self._period_s = period_s
        self.winding_c: Floats = np.zeros(shape)
        # Parameters.
        self._ambient_c = np.zeros(shape)
        self._rise = np.zeros(shape)  # K/(N·m)²
        # Fraction of the way to the settled temperature, in a control period.
        self._approach = np.zeros(shape)
        self._derate_from_c = np.ones(shape)
        self._stop_at_c = np.full(shape, 2.0)
        # Robots with a hot motor when `find_robots_to_derate` was called.
        self._derated = set[int]()

    def restart(self, robot_index: int, joints: Sequence[Joint]) -> None:
        """Start a robot with every winding at the ambient temperature."""
        time_s = np.array([-joint.heat.time_constant_s for joint in joints])
        self._ambient_c[robot_index] = [joint.heat.ambient_c for joint in joints]
        self._rise[robot_index] = [
            joint.heat.rise_at_rated_k / joint.rated_nm**2 for joint in joints
        ]
        self._approach[robot_index] = -np.expm1(self._period_s / time_s)
        self._derate_from_c[robot_index] = [joint.limits.derate_from_c for joint in joints]
        self._stop_at_c[robot_index] = [joint.limits.stop_at_c for joint in joints]
        self.winding_c[robot_index] = self._ambient_c[robot_index]
        self._derated.discard(robot_index)

    def advance_period(self, torque_nm: Floats) -> None:
        """Heat and cool the windings for a control period under these torques, (robots, joints)."""
        change_c = np.square(torque_nm)
        change_c *= self._rise
        change_c += self._ambient_c  # the settled temperature
        change_c -= self.winding_c
        change_c *= self._approach
        self.winding_c += change_c

    def find_robots_to_derate(self) -> list[int]:
        """Return the robots whose motors are to be derated anew: those that are hot, or were so at the last call."""
        hot = self.winding_c > self._derate_from_c
        if not np.count_nonzero(hot) and not self._derated:
            return []
        before = self._derated
        self._derated = set(np.flatnonzero(hot.any(axis=1)).tolist())
        return sorted(before | self._derated)

    def remaining_fractions(self, winding_c: Floats) -> Floats:
        """Return the fraction of its torque that each motor may use at these temperatures, (robots, joints)."""
        over = (winding_c - self._derate_from_c) / (self._stop_at_c - self._derate_from_c)
        return 1.0 - (1.0 - MIN_TORQUE_FRACTION) * np.minimum(np.maximum(over, 0.0), 1.0)

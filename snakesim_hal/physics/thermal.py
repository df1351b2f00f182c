"""Winding temperatures of joint modules, and their supply currents. For the simulator and emulated modules.

First order: copper losses are proportional to torque squared, and the housing dissipates them.

    time constant * d(temperature)/dt = ambient + rise * (torque / rated)^2 - temperature

The robot file's `[heat]` has the numbers, by default typical of a small geared servo: rated torque is available at
stall for seconds, half of it continuously (80 °C at 20 °C ambient, so 240 K at rated torque); the time constant is a
minute.

`HeatLimits` is the only derating curve: the host uses it, and so do the simulator's motors and emulated modules.
Each is an upper bound of the torque, so the lower one applies; they never multiply.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Joint

MIN_SHARE = 0.2  # of its torque, left to the hottest winding
INJECTED_ABOVE_STOP_K = 5.0  # by an injected fault


@dataclass(frozen=True)
class HeatLimits:
    """Temperatures at which derating begins, and the robot stops: the robot file's `derate_from_c` and `stop_at_c`."""

    derate_from_c: float
    stop_at_c: float

    def remaining_fraction(self, winding_c: float) -> float:
        """Share of the rated torque at a temperature: 1 up to `derate_from_c`, a fifth from `stop_at_c` on."""
        over = (winding_c - self.derate_from_c) / (self.stop_at_c - self.derate_from_c)
        return 1.0 - (1.0 - MIN_SHARE) * min(max(over, 0.0), 1.0)


class Thermal:
    """Winding temperatures of all motors, and the power that they take."""

    def __init__(self, joints: Sequence[Joint]) -> None:
        self.limits = [HeatLimits(joint.limits.derate_from_c, joint.limits.stop_at_c) for joint in joints]
        self.stop_at_c: Floats = np.array([limits.stop_at_c for limits in self.limits])
        self._derate_from_c = np.array([limits.derate_from_c for limits in self.limits])
        self._ambient_c = np.array([joint.heat.ambient_c for joint in joints])
        self.winding_c: Floats = self._ambient_c.copy()
        self._held = np.zeros(len(joints), dtype=np.bool_)
        self._derates = False
        self._rated_nm = np.array([joint.rated_nm for joint in joints])
        self._rise = np.array([joint.heat.rise_at_rated_k / joint.rated_nm**2 for joint in joints])
        self._minus_time_s = np.array([-joint.heat.time_constant_s for joint in joints])
        self._loss_w = np.array([joint.heat.loss_at_rated_w for joint in joints])
        self._board_fraction = np.array([joint.heat.board_fraction for joint in joints])

    def pass_time(self, seconds: float, torque_squared: Floats) -> None:
        """Heat and cool, under a mean square of torque, N²·m², (n_joints,). Exact for a constant torque."""
        settles_at = self._ambient_c + self._rise * torque_squared
        self.winding_c += (settles_at - self.winding_c) * -np.expm1(seconds / self._minus_time_s)
        np.copyto(self.winding_c, self.stop_at_c + INJECTED_ABOVE_STOP_K, where=self._held)

    def inject(self, motor: int, *, heat: bool, hold: bool) -> None:
        """Heat one winding as an injected fault; hold: keep that temperature until the fault ends."""
        if heat:
            self.winding_c[motor] = self.stop_at_c[motor] + INJECTED_ABOVE_STOP_K
        self._held[motor] = hold

    def remaining_fraction(self) -> Floats | None:
        """Share of its torque that each motor may use, (n_joints,); None while all are cool."""
        derated, self._derates = self._derates, bool((self.winding_c > self._derate_from_c).any())
        if not (self._derates or derated):
            return None
        shares = [
            of.remaining_fraction(celsius) for of, celsius in zip(self.limits, self.winding_c.tolist(), strict=True)
        ]
        return np.array(shares)

    def board_c(self) -> Floats:
        """Temperatures of the electronics beside the windings, (n_joints,)."""
        return self._ambient_c + self._board_fraction * (self.winding_c - self._ambient_c)

    def power_w(self, torque_nm: Floats, speed_rad_s: Floats) -> Floats:
        """What the motors take, (n_joints,): mechanical power and copper losses; `Supply.idle_a` comes on top."""
        return torque_nm * speed_rad_s + self._loss_w * (torque_nm / self._rated_nm) ** 2

"""Winding temperatures of joint modules, and their supply currents. For the simulator and emulated modules.

First order: copper losses are proportional to torque squared, and the housing dissipates them.

    time constant * d(temperature)/dt = ambient + rise * (torque / rated)^2 - temperature

No module was measured; the numbers are typical of a small geared servo: rated torque is available at stall for seconds,
half of it continuously (80 °C at 20 °C ambient, so 240 K at rated torque), and the time constant is a minute.

`HeatLimits` is the only derating curve: the host uses it, and so do the simulator's motors and emulated modules.
Each is an upper bound of the torque, so the lower one applies; they never multiply.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from snakesim_hal.arrays import Floats

Number = TypeVar("Number", float, Floats)

AMBIENT_C = 20.0
RISE_AT_RATED_K = 240.0
TIME_CONSTANT_S = 60.0
LOSS_AT_RATED_W = 48.0  # 5 K/W from winding to water, a guess of the right order for a housing of 100 mm
MIN_SHARE = 0.2  # of its torque, left to the hottest winding
INJECTED_ABOVE_STOP_K = 5.0  # by an injected fault
SUPPLY_V, MIN_VOLTAGE_V = 24.0, 18.0
IDLE_A = 0.05
BOARD_OVER_AMBIENT = 0.3  # of the winding's temperature rise, a guess


@dataclass(frozen=True)
class HeatLimits:
    """Temperatures at which derating begins, and the robot stops: the robot file's `derate_from_c` and `stop_at_c`."""

    derate_from_c: float
    stop_at_c: float

    def share_left(self, winding_c: float) -> float:
        """Share of the rated torque at a temperature: 1 up to `derate_from_c`, a fifth from `stop_at_c` on."""
        over = (winding_c - self.derate_from_c) / (self.stop_at_c - self.derate_from_c)
        return 1.0 - (1.0 - MIN_SHARE) * min(max(over, 0.0), 1.0)


class Thermal:
    """Winding temperatures of all motors."""

    def __init__(self, count: int, rated_nm: float, limits: HeatLimits) -> None:
        self.limits = limits
        self.winding_c: Floats = np.full(count, AMBIENT_C)
        self._held = np.zeros(count, dtype=np.bool_)
        self._derates = False
        self._rise = RISE_AT_RATED_K / rated_nm**2

    def pass_time(self, seconds: float, torque_squared: Floats) -> None:
        """Heat and cool, under a mean square of torque, N²·m², (n_joints,). Exact for a constant torque."""
        settles_at = AMBIENT_C + self._rise * torque_squared
        self.winding_c += (settles_at - self.winding_c) * -np.expm1(-seconds / TIME_CONSTANT_S)
        np.copyto(self.winding_c, self._injected_c, where=self._held)

    def inject(self, motor: int, *, heat: bool, hold: bool) -> None:
        """Heat one winding as an injected fault; hold: keep that temperature until the fault ends."""
        if heat:
            self.winding_c[motor] = self._injected_c
        self._held[motor] = hold

    def share_left(self) -> Floats | None:
        """Share of its rated torque that each motor may use, (n_joints,); None while all are cool."""
        derated, self._derates = self._derates, bool(self.winding_c.max() > self.limits.derate_from_c)
        if not (self._derates or derated):
            return None
        return np.array([self.limits.share_left(celsius) for celsius in self.winding_c.tolist()])

    @property
    def _injected_c(self) -> float:
        return self.limits.stop_at_c + INJECTED_ABOVE_STOP_K


def board_c(winding_c: Number) -> Number:
    """Temperature of the electronics beside a winding."""
    return AMBIENT_C + BOARD_OVER_AMBIENT * (winding_c - AMBIENT_C)


def current_a(torque_nm: Number, speed_rad_s: Number, rated_nm: float, voltage_v: float) -> Number:
    """Supply current of a module: mechanical power, copper losses, and a small idle current."""
    watts = torque_nm * speed_rad_s + LOSS_AT_RATED_W * (torque_nm / rated_nm) ** 2
    return IDLE_A + watts / voltage_v

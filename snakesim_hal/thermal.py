"""Heat in the windings of joint modules, and what they take from their supply. For the simulator and emulated modules.

First order: copper losses go with torque squared, and the housing takes them away.

    time constant * d(temperature)/dt = ambient + rise * (torque / rated)^2 - temperature

No module was measured. The numbers stand for a small geared servo: rated torque is what it has at stall for seconds,
half of it is what it holds for ever (80 °C at 20 °C ambient, so 240 K at rated torque), and it takes a minute to warm.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Number = TypeVar("Number", float, Floats)

AMBIENT_C = 20.0
RISE_AT_RATED_K = 240.0
TIME_CONSTANT_S = 60.0
LOSS_AT_RATED_W = 48.0  # 5 K/W from winding to water, a guess of the right order for a housing of 100 mm
FADES_FROM_C, FADED_C, LEAST_SHARE = 80.0, 100.0, 0.2  # of a module's own firmware
INJECTED_C = 110.0  # by a fault on request
OVERHEAT_C, COOLED_C = 105.0, 70.0  # a fault from the one up, gone below the other
SUPPLY_V, LEAST_VOLTAGE_V = 24.0, 18.0
IDLE_A = 0.05
BOARD_OVER_AMBIENT = 0.3  # of what the winding is warmer than the water, a guess


class Thermal:
    """Winding temperatures of all motors."""

    def __init__(self, count: int, rated_nm: float) -> None:
        self.winding_c: Floats = np.full(count, AMBIENT_C)
        self._held = np.zeros(count, dtype=np.bool_)
        self._rise = RISE_AT_RATED_K / rated_nm**2

    def pass_time(self, seconds: float, torque_squared: Floats) -> None:
        """Heat and cool, under a mean square of torque, N²·m², (n_joints,). Exact for a constant torque."""
        settles_at = AMBIENT_C + self._rise * torque_squared
        self.winding_c += (settles_at - self.winding_c) * -np.expm1(-seconds / TIME_CONSTANT_S)
        np.copyto(self.winding_c, INJECTED_C, where=self._held)

    def inject(self, motor: int, *, heat: bool, hold: bool) -> None:
        """Heat one winding by hand; hold: it stays as hot until told otherwise."""
        if heat:
            self.winding_c[motor] = INJECTED_C
        self._held[motor] = hold

    def share_left(self) -> Floats:
        """Which share of its torque limit each motor may still use, (n_joints,)."""
        over = (self.winding_c - FADES_FROM_C) / (FADED_C - FADES_FROM_C)
        return 1.0 - (1.0 - LEAST_SHARE) * np.clip(over, 0.0, 1.0)


def board_c(winding_c: Number) -> Number:
    """Temperature of the electronics beside a winding."""
    return AMBIENT_C + BOARD_OVER_AMBIENT * (winding_c - AMBIENT_C)


def current_a(torque_nm: Number, speed_rad_s: Number, rated_nm: float, voltage_v: float) -> Number:
    """What a module takes from its supply: mechanical power, copper losses, and a little when idle."""
    watts = torque_nm * speed_rad_s + LOSS_AT_RATED_W * (torque_nm / rated_nm) ** 2
    return IDLE_A + watts / voltage_v

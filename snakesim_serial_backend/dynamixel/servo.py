"""One servo: how it is built, what it reported last, and what was last sent to it."""

import math
from dataclasses import dataclass

from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.servo_bus import SerialServo

REVOLUTION_RAD = 2 * math.pi  # rad
SLACK_RAD = 0.3  # beyond its travel, where a servo may wake up
OUT_OF_REACH = 1.2  # factor on the angle at which full torque would be reached


@dataclass(kw_only=True)
class DynamixelServo(SerialServo[DynamixelPort]):
    """A servo of one joint. Angles and torques are those of its horn."""

    # How it is built.
    torque_constant_nm_per_a: float  # N·m/A
    stiffness: float  # N·m/rad
    damping: float  # N·m·s/rad
    lower_rad: float
    upper_rad: float
    torque_nm: float  # largest torque that its joint may demand
    speed_rad_s: float
    torque_unit_nm: float = 1.0  # torque of one unit of current
    max_current: int = 0  # its own limit, in units of current

    # What it reported.
    turns: int = 0  # whole revolutions to be added to the angle that it reports
    current_a: float = 0.0
    watchdog: int = 0

    def out_of_reach_rad(self, direction: float) -> float:
        """Return a goal so far beyond its travel that its position law demands full torque at any speed within.

        direction: positive for a goal above the upper limit, negative for one below the lower limit.
        """
        beyond_rad = (
            OUT_OF_REACH * (self.torque_nm + self.damping * self.speed_rad_s) / self.stiffness
        )
        if direction > 0:
            return self.upper_rad + beyond_rad
        return self.lower_rad - beyond_rad

    def encode_gain_registers(self) -> bytes:
        """Return the gains of its position law as registers."""
        return registers.gains_form.pack(
            *registers.gains(self.stiffness, self.damping, self.torque_unit_nm)
        )

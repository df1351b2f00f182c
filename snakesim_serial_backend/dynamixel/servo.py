"""One servo: how it is built, what it reported last, and what was last sent to it."""

import math
from dataclasses import dataclass

from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.port import Port

REVOLUTION_RAD = 2 * math.pi  # rad
SLACK_RAD = 0.3  # beyond its travel, where a servo may wake up
OUT_OF_REACH = 1.2  # factor on the angle at which full torque would be reached


@dataclass
class Servo:
    """A servo of one joint. Angles and torques are those of its horn."""

    # How it is built.
    id: int
    name: str
    port: Port
    constant: float  # N·m/A
    stiffness: float  # N·m/rad
    damping: float  # N·m·s/rad
    lower_rad: float
    upper_rad: float
    torque_nm: float  # largest torque that its joint may demand
    speed_rad_s: float
    unit_nm: float = 1.0  # torque of one unit of current
    max_current: int = 0  # its own limit, in units of current

    # What it reported.
    turns: int = 0  # whole revolutions to be added to the angle that it reports
    current_a: float = 0.0
    enabled: bool = False  # whether its torque is on
    watchdog: int = 0
    errors: int = 0  # bits of `HardwareError`
    alert: bool = False  # whether it has errors that it has not named yet
    health_ns: int = -1  # when its state was last read
    answered_twice: int = 0  # requests in a row
    garbled: int = 0  # requests in a row that were answered by garbled bytes alone

    # What was sent to it.
    follows: bool = False  # whether its torque was switched on
    switched_ns: int = -1  # when its torque was switched on or off
    booting_ns: int = -1  # when it was restarted, until it answers again

    @property
    def label(self) -> str:
        """The name of the servo in messages."""
        return f"{self.name} (id {self.id} on {self.port.wire.port})"

    def out_of_reach_rad(self, direction: float) -> float:
        """Return a goal so far beyond its travel that its position law demands full torque at any speed within.

        direction: positive for a goal above the upper limit, negative for one below the lower limit.
        """
        beyond_rad = OUT_OF_REACH * (self.torque_nm + self.damping * self.speed_rad_s) / self.stiffness
        if direction > 0:
            return self.upper_rad + beyond_rad
        return self.lower_rad - beyond_rad

    def gain_registers(self) -> bytes:
        """Return the gains of its position law as registers."""
        return at.gains_form.pack(*at.gains(self.stiffness, self.damping, self.unit_nm))

    def record_switch(self, *, follows: bool, now_ns: int) -> None:
        """Record that its torque was switched on or off."""
        self.follows = follows
        self.switched_ns = now_ns
        self.enabled = False  # until it reports otherwise

"""One servo: how it is built, what it said last, and what it was told."""

import math
from dataclasses import dataclass

from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.port import Port

TURN = 2 * math.pi
SLACK_RAD = 0.3  # beyond its travel, where a servo may wake up
OUT_OF_REACH = 1.2  # of the angle in which full torque would be reached


@dataclass
class Servo:
    """Angles and torques are at its horn."""

    id: int
    name: str
    port: Port
    constant: float  # N·m/A
    stiffness: float  # N·m/rad
    damping: float  # N·m·s/rad
    lower_rad: float
    upper_rad: float
    torque_nm: float  # that its joint may ask of it
    speed_rad_s: float
    unit_nm: float = 1.0  # of a unit of current
    most_current: int = 0  # its own limit
    turns: int = 0  # to be added to what it says
    current_a: float = 0.0
    follows: bool = False
    told_ns: int = -1  # when it was told so
    enabled: bool = False  # whether its torque is on, as it said
    watchdog: int = 0
    health_ns: int = -1  # when it said so
    errors: int = 0
    alert: bool = False  # whether it has errors that it has not named
    booting_ns: int = -1  # since it was told to restart
    answered_twice: int = 0  # questions in a row
    garbled: int = 0  # questions in a row that only garbled bytes answered

    @property
    def who(self) -> str:
        """As messages name it."""
        return f"{self.name} (id {self.id} on {self.port.wire.port})"

    def out_of_reach_rad(self, towards: float) -> float:
        """A goal beyond its travel by so much that its law asks for full torque at any speed within."""
        beyond_rad = OUT_OF_REACH * (self.torque_nm + self.damping * self.speed_rad_s) / self.stiffness
        return self.upper_rad + beyond_rad if towards > 0 else self.lower_rad - beyond_rad

    def gains(self) -> bytes:
        """Of its position law, as registers."""
        return at.gains_form.pack(*at.gains(self.stiffness, self.damping, self.unit_nm))

    def told(self, *, follows: bool, now_ns: int) -> None:
        """Its torque was switched on or off."""
        self.follows, self.told_ns, self.enabled = follows, now_ns, False

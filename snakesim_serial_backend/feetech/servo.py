"""One Feetech servo: how it is built, what it reported last, and what was last sent to it."""

from dataclasses import dataclass

from snakesim_serial_backend.feetech.port import FeetechPort
from snakesim_serial_backend.servo_bus import SerialServo

SLACK_RAD = 0.3  # beyond its travel, where a servo may wake up


@dataclass(kw_only=True)
class FeetechServo(SerialServo[FeetechPort]):
    """A servo of one joint. Angles and torques are those of its horn."""

    # How it is built.
    lower_rad: float
    upper_rad: float
    torque_nm: float  # largest torque that its joint may demand
    stall_torque_nm: float
    min_voltage_v: float  # below it the robot is stopped
    homing_offset: int | None = None  # that it must have, in counts; None: any
    max_per_mille: int = 0  # its own torque limit

    # What it reported.
    firmware: str = ""
    current_a: float = 0.0
    # Since its torque was switched on: it has forgotten what it was sent.
    has_restarted: bool = False

    # What happened to it.
    # How long it held its last goal while the driver did not run, until a reset; 0: it did not.
    unsupervised_s: float = 0.0

"""The control table of the X series, its models, and between its units and SI. Pure; from ROBOTIS' e-Manual.

What is below address 64 is kept without power, and may be written only with torque off.
"""

import math
from dataclasses import dataclass
from enum import IntFlag
from struct import Struct

COUNTS = 4096  # a turn
RAD = 2 * math.pi / COUNTS  # a count
SPEED = 0.229 * 2 * math.pi / 60  # rad/s, a unit of velocity
VOLTS = 0.1
WATCHDOG_S = 0.02  # a unit of it
TRIPPED = 0xFF  # the watchdog's value, -1, after it has stopped a servo
P_SCALE, D_SCALE = 128, 16  # of the gains' registers
LAW_S = 0.001  # in which the position law takes its difference: assumed
MOST_GAIN = 16383
CURRENT_BASED_POSITION = 5
FIRST_FIRMWARE = 38  # with a bus watchdog

MODEL = 0  # 2 bytes, with the model's information 6, and the firmware
KEPT = 64  # bytes from 0 on
DELAY = 9  # of an answer
DRIVE_MODE, OPERATING_MODE = 10, 11
SECONDARY_ID = 12  # a servo takes writes to it, too; 253 and above: off
HOMING_OFFSET = 20
LEAST_VOLTAGE, CURRENT_LIMIT = 34, 38
STARTUP = 60  # bit 0: torque on when it starts
TORQUE_ENABLE = 64
STATUS_LEVEL = 68
HARDWARE_ERROR = 70
GAINS = 80  # D, I, P of the position law
WATCHDOG = 98
GOALS = 102
GOAL_POSITION = 116
PRESENT = 126
VOLTAGE, TEMPERATURE = 144, 146
SIZE = 147  # of what is used here

RATE = {9600: 0, 57600: 1, 115200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6, 4_500_000: 7}
gains_form = Struct("<HHH")
goals_form = Struct("<hiIIi")  # current, velocity, acceleration and velocity of the profile (0: none), position
present_form = Struct("<hii")  # current, velocity, position: signed
HEALTH_SIZE = TEMPERATURE + 1 - TORQUE_ENABLE  # from TORQUE_ENABLE on
STATE_SIZE = WATCHDOG + 1 - TORQUE_ENABLE  # from TORQUE_ENABLE on: torque, hardware error, watchdog


class HardwareError(IntFlag):
    """Why a servo is in alert; what `shutdown` names has switched its torque off, and only a restart clears it."""

    INPUT_VOLTAGE = 0x01
    OVERHEATING = 0x04
    MOTOR_ENCODER = 0x08
    ELECTRICAL_SHOCK = 0x10
    OVERLOAD = 0x20


@dataclass(frozen=True)
class Model:
    """What a model number says."""

    name: str
    current_a: float | None  # a unit of current; None: not known here


MODELS = {
    1000: Model("XH430-W350", 0.00269),
    1010: Model("XH430-W210", 0.00269),
    1020: Model("XM430-W350", 0.00269),
    1030: Model("XM430-W210", 0.00269),
    1120: Model("XM540-W270", 0.00269),
    1130: Model("XM540-W150", 0.00269),
    1190: Model("XL330-M077", 0.001),
    1200: Model("XL330-M288", 0.001),
    1210: Model("XC330-T181", 0.001),
    1220: Model("XC330-T288", 0.001),
    1230: Model("XC330-M181", 0.001),
    1240: Model("XC330-M288", 0.001),
}
WITHOUT_CURRENT = {
    350: "XL320",
    1060: "XL430-W250",
    1070: "XC430-W150",
    1080: "XC430-W240",
    1090: "2XL430-W250",
    1160: "2XC430-W250",
}


def model_name(number: int) -> str:
    """As people know it."""
    known = MODELS.get(number)
    return known.name if known else WITHOUT_CURRENT.get(number, f"model {number}")


def error_names(errors: int) -> str:
    """Bits of a hardware error in words."""
    said = [error.name.lower().replace("_", " ") for error in HardwareError if errors & error and error.name]
    return ", ".join(said) or f"0x{errors:02x}"


def gains(stiffness: float, damping: float, unit_nm: float) -> tuple[int, int, int]:
    """D, I and P for N·m/rad and N·m·s/rad at the horn. unit_nm: torque of a unit of current.

    Assumed: the law's output is in units of current, its error in counts, and its difference over `LAW_S`.
    """
    p, d = stiffness * RAD / unit_nm * P_SCALE, damping * RAD / LAW_S / unit_nm * D_SCALE
    return min(round(d), MOST_GAIN), 0, min(round(p), MOST_GAIN)


def law(d: int, p: int, unit_nm: float) -> tuple[float, float]:
    """Stiffness and damping of gains, the other way round."""
    return p / P_SCALE * unit_nm / RAD, d / D_SCALE * unit_nm / RAD * LAW_S


def whole_turns(angle_rad: float, lower_rad: float, upper_rad: float, slack_rad: float) -> int | None:
    """Turns to add to what a servo says, so that it is within its travel; None: there are none, or several such."""
    turn = 2 * math.pi
    first = math.ceil((lower_rad - slack_rad - angle_rad) / turn)
    last = math.floor((upper_rad + slack_rad - angle_rad) / turn)
    return first if first == last else None

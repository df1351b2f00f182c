"""The control table of the X series, its models, and the conversion of its units to SI units. Pure.

The registers below address 64 last without power, and may be written only with torque off.

Source: ROBOTIS' public e-Manual, "Control Table" of the X series.
"""

import math
from dataclasses import dataclass
from enum import IntFlag
from struct import Struct

# Units.
COUNTS = 4096  # in a revolution
RAD = 2 * math.pi / COUNTS  # in a count
SPEED = 0.229 * 2 * math.pi / 60  # rad/s in a unit of velocity
VOLTS = 0.1  # in a unit of voltage
WATCHDOG_S = 0.02  # in a unit of the bus watchdog
P_SCALE = 128  # divides the register of the P gain
D_SCALE = 16  # divides the register of the D gain
LAW_S = 0.001  # time over which the position law takes its difference: assumed
MAX_GAIN = 16383

# Values of registers.
CURRENT_CONTROL = 0  # operating mode
CURRENT_BASED_POSITION = 5  # operating mode
TRIPPED = 0xFF  # value of the watchdog, -1, after it has stopped a servo
FIRST_FIRMWARE = 38  # the first one with a bus watchdog

# Addresses.
MODEL = 0  # 2 bytes; the model's information follows at 2, and the firmware at 6
EEPROM_SIZE = 64  # size of the registers that last without power, from 0 on
BAUD_RATE = 8
DELAY = 9  # of an answer
DRIVE_MODE = 10
OPERATING_MODE = 11
SECONDARY_ID = 12  # a servo executes writes to this id, too; 253 and above: off
HOMING_OFFSET = 20
MIN_VOLTAGE = 34
CURRENT_LIMIT = 38
STARTUP = 60  # bit 0: torque on when it starts
TORQUE_ENABLE = 64
STATUS_LEVEL = 68
HARDWARE_ERROR = 70
GAINS = 80  # D, I, P of the position law
P_GAIN = 84
WATCHDOG = 98
GOALS = 102  # from the goal current on
GOAL_POSITION = 116
PRESENT = 126  # from the present current on
PRESENT_VELOCITY = 128
PRESENT_POSITION = 132
VOLTAGE = 144
TEMPERATURE = 146
SIZE = 147  # of the part of the control table that is used here

# Value of the baud rate's register for each rate in bit/s.
RATE = {
    9600: 0,
    57600: 1,
    115200: 2,
    1_000_000: 3,
    2_000_000: 4,
    3_000_000: 5,
    4_000_000: 6,
    4_500_000: 7,
}

# Groups of registers that are read or written at once.
gains_form = Struct("<HHH")  # D, I, P
# Current, velocity, acceleration and velocity of the profile (0: none), position.
goals_form = Struct("<hiIIi")
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
class DynamixelModel:
    """What is known of a model by its number."""

    name: str
    current_a: float | None  # in a unit of current; None: not known here


MODELS = {
    1000: DynamixelModel("XH430-W350", 0.00269),
    1010: DynamixelModel("XH430-W210", 0.00269),
    1020: DynamixelModel("XM430-W350", 0.00269),
    1030: DynamixelModel("XM430-W210", 0.00269),
    1120: DynamixelModel("XM540-W270", 0.00269),
    1130: DynamixelModel("XM540-W150", 0.00269),
    1190: DynamixelModel("XL330-M077", 0.001),
    1200: DynamixelModel("XL330-M288", 0.001),
    1210: DynamixelModel("XC330-T181", 0.001),
    1220: DynamixelModel("XC330-T288", 0.001),
    1230: DynamixelModel("XC330-M181", 0.001),
    1240: DynamixelModel("XC330-M288", 0.001),
}
WITHOUT_CURRENT = {
    350: "XL320",
    1060: "XL430-W250",
    1070: "XC430-W150",
    1080: "XC430-W240",
    1090: "2XL430-W250",
    1160: "2XC430-W250",
}


def get_model_name(number: int) -> str:
    """Return the name of a model as its maker writes it."""
    model = MODELS.get(number)
    if model is not None:
        return model.name
    return WITHOUT_CURRENT.get(number, f"model {number}")


def find_model_number(name: str) -> int | None:
    """Return the number of a model with this name, as `get_model_name` returns it; None for an unknown name."""
    names = {number: model.name for number, model in MODELS.items()} | WITHOUT_CURRENT
    for number, known_name in names.items():
        if known_name == name:
            return number
    word, _, number_text = name.partition(" ")
    if word == "model" and number_text.isdecimal():
        return int(number_text)
    return None


def describe_errors(error_count: int) -> str:
    """Return the names of the bits of a hardware error."""
    names = [
        error.name.lower().replace("_", " ")
        for error in HardwareError
        if error_count & error and error.name
    ]
    return ", ".join(names) or f"0x{error_count:02x}"


def gains(stiffness: float, damping: float, torque_unit_nm: float) -> tuple[int, int, int]:
    """Return the registers of the gains D, I and P for a stiffness and a damping at the horn.

    Assumed: the output of the position law is in units of current, its error in counts, and its difference is taken
    over `LAW_S`:

        current = P / P_SCALE * error + D / D_SCALE * difference of the error

    Args:
        stiffness: N·m/rad.
        damping: N·m·s/rad.
        torque_unit_nm: Torque of one unit of current, N·m.
    """
    p_gain = stiffness * RAD / torque_unit_nm * P_SCALE
    d_gain = damping * RAD / LAW_S / torque_unit_nm * D_SCALE
    return min(round(d_gain), MAX_GAIN), 0, min(round(p_gain), MAX_GAIN)


def compute_position_law(d_gain: int, p_gain: int, torque_unit_nm: float) -> tuple[float, float]:
    """Return the stiffness in N·m/rad and the damping in N·m·s/rad of gains: the inverse of `gains`."""
    stiffness = p_gain / P_SCALE * torque_unit_nm / RAD
    damping = d_gain / D_SCALE * torque_unit_nm / RAD * LAW_S
    return stiffness, damping


def find_whole_turns(
    angle_rad: float, lower_rad: float, upper_rad: float, slack_rad: float
) -> int | None:
    """Return the number of whole revolutions to add to a reported angle, so that a servo is within its travel.

    Args:
        angle_rad: Reported angle.
        lower_rad: Lower end of the travel.
        upper_rad: Upper end of the travel.
        slack_rad: Angle beyond both ends that is still accepted.

    Returns:
        The number of revolutions; None if no number or several numbers are possible.
    """
    turn_rad = 2 * math.pi
    first = math.ceil((lower_rad - slack_rad - angle_rad) / turn_rad)
    last = math.floor((upper_rad + slack_rad - angle_rad) / turn_rad)
    if first != last:
        return None
    return first

"""The control table of STS servos, their models, and the conversion of its units to SI units. Pure.

Two sources agree on the addresses below: the maker's SDK, `FTServo_Python`, and LeRobot's `motors/feetech/tables.py`.
All that neither source establishes is under "Assumed". No promise depends on it, and no test against an emulator can
find an error in it.

Registers below address 40 last without power. They are written with torque off and the lock, register 55, open.
"""

import math
from struct import Struct

from snakesim_serial_backend.feetech.packets import ServoError

# Units.
COUNTS = 4096  # in a revolution
RAD = 2 * math.pi / COUNTS  # in a count
MIDDLE = 2048  # the position that counts as angle 0, so that angles are from -pi to pi
LAST_POSITION = COUNTS - 1  # no goal is beyond, and the count starts again at 0
VOLTS = 0.1  # in a unit of voltage

# Assumed.
CURRENT_A = 0.0065  # in a unit of the present current, without a sign
PER_MILLE = 1000  # of the stall torque: unit of torque limits
PROTECTION_TIME_S = 0.01  # in a unit of the protection time
# No ramp, as LeRobot sets it; a servo that restarts forgets it, so it also shows a restart.
ACCELERATION = 254
# A unit of speed is 1 count/s in older examples of the maker and 50 counts/s in newer ones: a setting.
# Not known at all: the unit of the load, which is not used, and what the P, D and I gains are in N·m/rad.
# A write of a goal may switch the torque on by itself: the maker's examples never write register 40.

# Values of registers.
POSITION_MODE = 0
MULTI_TURN_FEEDBACK = 0x10  # bit of the phase: positions beyond one revolution
OPEN = 0  # value of the lock
LOCKED = 1

# Addresses.
FIRMWARE = 0  # major, and minor at 1
MODEL = 3  # 2 bytes
ID = 5
BAUD_RATE = 6
DELAY = 7  # of an answer, in 2 us
STATUS_LEVEL = 8  # 1: a servo answers writes, too
MIN_POSITION = 9
MAX_POSITION = 11
MAX_TEMPERATURE = 13
MAX_VOLTAGE = 14
MIN_VOLTAGE = 15
MAX_TORQUE = 16
PHASE = 18
UNLOADING = 19  # the errors, bits of `ServoError`, that switch the torque off
HOMING_OFFSET = 31
OPERATING_MODE = 33
PROTECTIVE_TORQUE = 34  # percent, which an overloaded servo keeps
PROTECTION_TIME = 35
OVERLOAD_TORQUE = 36  # percent, that counts as overload
EEPROM_SIZE = 40  # size of the registers that last without power, from 0 on
TORQUE_ENABLE = 40
ACCELERATION_ADDRESS = 41
GOALS = 42  # position, time, speed, torque limit
TORQUE_LIMIT = 48
LOCK = 55
PRESENT = 56
VOLTAGE = 62
TEMPERATURE = 63
STATUS = 65
CURRENT = 69
SIZE = 87  # of the control table

# Value of the baud rate's register for each rate in bit/s, as far as both sources agree.
RATE = {115_200: 4, 128_000: 3, 250_000: 2, 500_000: 1, 1_000_000: 0}

# Groups of registers that are read or written at once.
goals_form = Struct("<HHHH")  # position, time (0: none), speed (0: the greatest), torque limit
present_form = Struct("<HHHBB")  # position, speed, load, voltage, temperature
STATE_SIZE = CURRENT + 2 - TORQUE_ENABLE  # from TORQUE_ENABLE on

MODELS = {777: "STS3215", 2825: "STS3250"}


def get_model_name(number: int) -> str:
    """Return the name of a model as its maker writes it."""
    return MODELS.get(number, f"model {number}")


def describe_errors(error_count: int) -> str:
    """Return the names of the bits of an error."""
    names = [
        error.name.lower().replace("_", " ")
        for error in ServoError
        if error_count & error and error.name
    ]
    return ", ".join(names) or f"0x{error_count:02x}"


def to_angle_rad(position: int) -> float:
    """Return the angle of a position; the middle of the count is 0."""
    return (position - MIDDLE) * RAD


def to_position(angle_rad: float) -> int:
    """Return the position of an angle, limited to one revolution."""
    return min(max(round(angle_rad / RAD) + MIDDLE, 0), LAST_POSITION)

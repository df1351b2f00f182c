"""The bus protocol of the joint modules, version 1: ids, states, actions and parameters.

Layouts and scales are only in `schemas/can/snakesim.dbc`; tests compare the numbers here with its value
tables. The specification is `docs/reference/can-protocol.md`.
"""

from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

PROTOCOL_VERSION = 1

# Ids: the upper five bits are the opcode, the lower six the node.
NODE_BITS = 6
NODE_MASK = (1 << NODE_BITS) - 1
BROADCAST = 0  # node of frames to all modules
FIRST_NODE = 1
LAST_NODE = 62

COMMAND_KEY = 0x5AAE  # in every Command, so that no other frame can be taken for one

# Counters of setpoints and states.
COUNTER_MODULUS = 16  # they have four bits
# That may be missing before one; a count further ahead, or an earlier one, is wrong.
MAX_LOST_SETPOINTS = 2
MAX_WRONG_COUNTS = 5  # in a row, after which a module stops

# Reports that modules send by themselves.
HEARTBEAT_PERIOD_S = 0.1
HEALTH_PERIOD_S = 0.5
UPTIME_RANGE_MS = 1 << 32  # of a heartbeat: 49.7 days
MAX_UPTIME_MS = UPTIME_RANGE_MS - 1  # where an uptime stays from then on


class Opcode(IntEnum):
    """The kind of a message: the upper five bits of an id. The lowest wins arbitration."""

    EMERGENCY = 0
    COMMAND = 1
    SYNC = 2
    SET_POINT = 3
    JOINT_STATE = 4
    CONTACT = 5
    TAIL_CONTACT = 6
    HEARTBEAT = 7
    GYRO = 8
    ACCELEROMETER = 9
    SHAFT_LOAD = 10
    HEALTH = 11
    IDENTITY = 12
    PARAMETER_ANSWER = 13
    PARAMETER_REQUEST = 16


FROM_HOST = frozenset(
    (Opcode.EMERGENCY, Opcode.COMMAND, Opcode.SYNC, Opcode.SET_POINT, Opcode.PARAMETER_REQUEST)
)
WITH_CHECKSUM = frozenset((Opcode.COMMAND, Opcode.SET_POINT, Opcode.JOINT_STATE))


class ModuleState(IntEnum):
    """State of a module. Only `ARMED` follows setpoints; only `ARMED` and `STOPPING` drive the motor."""

    BOOT = 0
    DISARMED = 1
    ARMED = 2
    STOPPING = 3  # damps until at rest, at most for the watchdog's time; then passive and DISARMED
    FAULT = 4  # passive; latched until cleared or rebooted
    EMERGENCY = 5  # passive; latched until cleared or rebooted


class CommandAction(IntEnum):
    """Action of a Command."""

    ARM = 1
    DISARM = 2  # passive at once
    STOP = 3  # stop mode, then disarmed
    CLEAR = 4
    REBOOT = 5
    IDENTIFY = 6


class LastStop(IntEnum):
    """Why a module last left `ARMED`."""

    NONE = 0
    DISARM = 1
    STOP = 2
    WATCHDOG = 3
    STREAM = 4
    OVERHEAT = 5
    LEAK = 6
    VOLTAGE = 7
    SENSOR = 8
    EMERGENCY = 9
    REBOOT = 10


class ModuleFault(IntEnum):
    """Fault bits of a heartbeat, lowest first."""

    WATCHDOG = 0
    STREAM = 1
    OVERHEAT = 2
    LEAK = 3
    VOLTAGE = 4
    SENSOR = 5


class EmergencyReason(IntEnum):
    """What sent an Emergency."""

    UNSPECIFIED = 0
    PERSON = 1
    HOST = 2


class ParameterOperation(IntEnum):
    """Operation of a ParameterRequest."""

    READ = 0
    WRITE = 1
    SAVE = 2


class ParameterResult(IntEnum):
    """Result of a ParameterRequest."""

    DONE = 0
    UNKNOWN_INDEX = 1
    READ_ONLY = 2
    OUT_OF_RANGE = 3
    NOT_WHILE_ARMED = 4
    UNKNOWN_OPERATION = 5


class SafeMotion(IntEnum):
    """Parameter `stop_mode`: action in `STOPPING`."""

    PASSIVE = 0
    DAMP = 1


class ModuleParameter(IntEnum):
    """Index of every parameter."""

    STIFFNESS = 1
    DAMPING = 2
    VELOCITY_GAIN = 3
    TORQUE_LIMIT = 4
    SPEED_LIMIT = 5
    ANGLE_LIMIT = 6
    WATCHDOG = 7
    STOP_MODE = 8
    CONTACT_EVERY = 9
    IMU_EVERY = 10
    TAIL = 11
    RATED_TORQUE = 12
    RATED_SPEED = 13


@dataclass(frozen=True)
class ParameterRange:
    """Range and unit of a parameter."""

    low: float
    high: float
    unit: str
    writable: bool = True


PARAMETERS: dict[ModuleParameter, ParameterRange] = {
    ModuleParameter.STIFFNESS: ParameterRange(0.0, 1e5, "N·m/rad"),
    ModuleParameter.DAMPING: ParameterRange(0.0, 1e4, "N·m·s/rad"),
    ModuleParameter.VELOCITY_GAIN: ParameterRange(0.0, 1e4, "N·m·s/rad"),
    ModuleParameter.TORQUE_LIMIT: ParameterRange(0.0, 32.767, "N·m"),
    ModuleParameter.SPEED_LIMIT: ParameterRange(0.0, 32.767, "rad/s"),
    ModuleParameter.ANGLE_LIMIT: ParameterRange(0.0, 3.2767, "rad"),
    ModuleParameter.WATCHDOG: ParameterRange(0.02, 0.1, "s"),
    ModuleParameter.STOP_MODE: ParameterRange(0, 1, "0 passive, 1 damp"),
    ModuleParameter.CONTACT_EVERY: ParameterRange(0, 255, "Syncs, 0 never"),
    ModuleParameter.IMU_EVERY: ParameterRange(0, 255, "Syncs, 0 never"),
    ModuleParameter.TAIL: ParameterRange(0, 1, "1: sends TailContact too"),
    ModuleParameter.RATED_TORQUE: ParameterRange(0.0, 32.767, "N·m", writable=False),
    ModuleParameter.RATED_SPEED: ParameterRange(0.0, 32.767, "rad/s", writable=False),
}


class CanFrame(NamedTuple):
    """A data frame on the bus."""

    id: int
    data: bytes


def frame_id(opcode: Opcode, node_id: int) -> int:
    """Return the id of a message to or from a node; node 0 is broadcast."""
    return opcode << NODE_BITS | node_id


def parse_opcode(identifier: int) -> int:
    """Return the opcode in an id. It need not be one of `Opcode`."""
    return identifier >> NODE_BITS


def parse_node(identifier: int) -> int:
    """Return the node in an id: the sender or the receiver."""
    return identifier & NODE_MASK


def checksum(identifier: int, data: bytes) -> int:
    """Return the checksum of a frame: the low byte of CRC-16/XMODEM over the data before it.

    The id is the initial value, so that a frame cannot be confused with one of another id.
    """
    return crc_hqx(data, identifier) & 0xFF


def has_valid_checksum(frame: CanFrame) -> bool:
    """Return whether the last byte of a frame is the checksum of the others."""
    return crc_hqx(frame.data[:-1], frame.id) & 0xFF == frame.data[-1]

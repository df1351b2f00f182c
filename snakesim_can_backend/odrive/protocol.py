"""CANSimple: messages of ODrive axes as bytes.

An id is node << 5 | message. All numbers are little-endian. A request is the message without data.

Written from ODrive's public documentation; tests hold it against the database that ODrive publishes.
"""

from enum import IntEnum, IntFlag
from struct import Struct

from snakesim_can_backend.protocol.definitions import CanFrame

NODE_BITS = 5
LAST_NODE = 62
FIRMWARE = (0, 6)


class MessageId(IntEnum):
    """The low five bits of an id."""

    VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    ERROR = 0x03
    RX_SDO = 0x04  # request for a setting, or a new value of one
    TX_SDO = 0x05  # the answer
    ADDRESS = 0x06
    SET_STATE = 0x07
    MOTION = 0x09
    SET_MODE = 0x0B
    SET_POSITION = 0x0C
    SET_VELOCITY = 0x0D
    SET_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    CURRENT = 0x14
    TEMPERATURE = 0x15
    SUPPLY = 0x17
    CLEAR_ERRORS = 0x18
    SET_POSITION_GAIN = 0x1A
    SET_VELOCITY_GAINS = 0x1B


class AxisState(IntEnum):
    """The states of an axis that are used here; others are calibrations."""

    IDLE = 1
    CLOSED_LOOP = 8


class ControlMode(IntEnum):
    """What an axis controls."""

    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


PASSTHROUGH = 1  # input mode: an input acts at once


class AxisError(IntFlag):
    """Bits of the active errors, firmware 0.6."""

    INITIALIZING = 0x1
    SYSTEM_LEVEL = 0x2
    TIMING_ERROR = 0x4
    MISSING_ESTIMATE = 0x8
    BAD_CONFIG = 0x10
    DRV_FAULT = 0x20
    MISSING_INPUT = 0x40
    DC_BUS_OVER_VOLTAGE = 0x100
    DC_BUS_UNDER_VOLTAGE = 0x200
    DC_BUS_OVER_CURRENT = 0x400
    DC_BUS_OVER_REGEN_CURRENT = 0x800
    CURRENT_LIMIT_VIOLATION = 0x1000
    MOTOR_OVER_TEMP = 0x2000
    INVERTER_OVER_TEMP = 0x4000
    VELOCITY_LIMIT_VIOLATION = 0x8000
    POSITION_LIMIT_VIOLATION = 0x10000
    REQUESTED_CURRENT_TOO_HIGH = 0x20000
    WATCHDOG_TIMER_EXPIRED = 0x1000000
    ESTOP_REQUESTED = 0x2000000
    SPINOUT_DETECTED = 0x4000000
    BRAKE_RESISTOR_DISARMED = 0x8000000
    THERMISTOR_DISCONNECTED = 0x10000000
    CALIBRATION_ERROR = 0x40000000


PAYLOADS = {
    MessageId.VERSION: Struct("<8B"),  # protocol, hardware (3), firmware (3), unreleased
    MessageId.HEARTBEAT: Struct(
        "<IBBBx"
    ),  # active errors, state, result of the last procedure, trajectory done
    MessageId.ESTOP: Struct(""),
    MessageId.ERROR: Struct("<II"),  # active errors, reason of the last disarming
    MessageId.ADDRESS: Struct(
        "<B6sB"
    ),  # node, serial number, connection; only of 0.6: a command in 0.5
    MessageId.SET_STATE: Struct("<I"),
    MessageId.MOTION: Struct("<ff"),  # turns, turns/s
    MessageId.SET_MODE: Struct("<II"),  # what it controls, input mode
    MessageId.SET_POSITION: Struct("<fhh"),  # turns; feed-forward of velocity and torque, by 0.001
    MessageId.SET_VELOCITY: Struct("<ff"),  # turns/s, feed-forward of torque, N·m
    MessageId.SET_TORQUE: Struct("<f"),  # N·m
    MessageId.SET_LIMITS: Struct("<ff"),  # turns/s, A
    MessageId.CURRENT: Struct("<ff"),  # Iq: setpoint and measured, A
    MessageId.TEMPERATURE: Struct("<ff"),  # of the power stage and of the motor, °C
    MessageId.SUPPLY: Struct("<ff"),  # V, A
    MessageId.CLEAR_ERRORS: Struct(""),
    MessageId.SET_POSITION_GAIN: Struct("<f"),  # (turns/s) / turn
    MessageId.SET_VELOCITY_GAINS: Struct("<ff"),  # N·m / (turn/s), and of the integral
}
READ_SETTING = 0  # first byte of RxSdo
WRITE_SETTING = 1
# Opcode, or reserved in an answer; endpoint id; reserved. The value follows.
SDO_HEADER = Struct("<BHB")
SETTERS = frozenset(message_id for message_id in MessageId if message_id.name.startswith("SET_"))
FROM_HOST = SETTERS | {MessageId.ESTOP, MessageId.CLEAR_ERRORS}  # messages that only a host sends


def encode_message(node_id: int, message_id: MessageId, *values: float | bytes) -> CanFrame:
    """Return a message of, or to, an axis."""
    return CanFrame(node_id << NODE_BITS | message_id, PAYLOADS[message_id].pack(*values))


def encode_request(node_id: int, message_id: MessageId) -> CanFrame:
    """Return the request for a message: the message without data."""
    return CanFrame(node_id << NODE_BITS | message_id, b"")


def encode_setting_request(node_id: int, endpoint: int) -> CanFrame:
    """Return the request for the setting with an endpoint id."""
    return CanFrame(
        node_id << NODE_BITS | MessageId.RX_SDO, SDO_HEADER.pack(READ_SETTING, endpoint, 0)
    )


def encode_setting_answer(node_id: int, endpoint: int, value: bytes) -> CanFrame:
    """Return an axis' answer to the request for a setting."""
    return CanFrame(
        node_id << NODE_BITS | MessageId.TX_SDO, SDO_HEADER.pack(0, endpoint, 0) + value
    )


def decode_setting_answer(data: bytes) -> tuple[int, bytes]:
    """Return endpoint id and value of an answer with a setting.

    Raises:
        struct.error: The answer is too short.
    """
    _, endpoint, _ = SDO_HEADER.unpack_from(data)
    return endpoint, data[SDO_HEADER.size :]


def split_id(frame: CanFrame) -> tuple[int, int]:
    """Return node and message number of a frame."""
    return frame.id >> NODE_BITS, frame.id & ((1 << NODE_BITS) - 1)


def describe_errors(error_count: int) -> str:
    """Return the error bits in words; empty if there are none."""
    known = [error.name.lower() for error in AxisError if error_count & error and error.name]
    if known:
        return ", ".join(known)
    return f"0x{error_count:x}" if error_count else ""

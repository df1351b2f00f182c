"""Registers of moteus controllers in CAN FD frames.

An id is source << 8 | destination, with a bit that requests a reply. The data are subframes: each writes, reads or
answers consecutive registers, in one of four types. Written from mjbots' public documentation;
tests hold it against mjbots' own library.
"""

from collections.abc import Iterator
from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from snakesim_can_backend.protocol.definitions import CanFrame

HOST_ID = 0
LAST_ID = 126
BROADCAST_ID = 127  # every controller receives its frames
REPLY_REQUESTED_BIT = 0x8000
REGISTER_MAP = 5  # the version of the register map that this file describes
# Kinds of subframes: the high bits of their first byte.
WRITE = 0x00
READ = 0x10
REPLY = 0x20
PADDING = 0x50  # padding
# Types of values: the next two bits.
INT8 = 0
INT16 = 1
INT32 = 2
FLOAT = 3
VALUE_FORMATS = (Struct("<b"), Struct("<h"), Struct("<i"), Struct("<f"))
# Possible data lengths of CAN FD, bytes.
CAN_FD_DATA_LENGTHS = *range(9), 12, 16, 20, 24, 32, 48, 64


class Register(IntEnum):
    """The registers that are used here."""

    MODE = 0x000
    POSITION = 0x001  # turns
    VELOCITY = 0x002  # turns/s
    TORQUE = 0x003  # N·m
    POWER = 0x007  # W
    MOTOR_TEMPERATURE = 0x00A  # °C
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D  # V
    BOARD_TEMPERATURE = 0x00E  # °C
    FAULT = 0x00F
    COMMAND = 0x020  # position, velocity, feed-forward torque, kp scale, kd scale, maximum torque; NaN: where it is
    WATCHDOG = 0x027  # s; then limits of velocity and acceleration, below 0: none
    MAP_VERSION = 0x102
    SERIAL = 0x120  # three words of 32 bits, the lowest one first


class MoteusMode(IntEnum):
    """What a controller does; those between FAULT and POSITION prepare it, or are of other uses."""

    STOPPED = 0
    FAULT = 1
    POSITION = 10
    TIMEOUT = 11


HOME_STATE_RELATIVE = 0  # home state: the position has no reference
FAULTS = {
    32: "calibration",
    33: "motor driver",
    34: "over-voltage",
    35: "encoder",
    36: "motor not configured",
    38: "over-temperature",
    39: "outside the position limits",
    40: "under-voltage",
    43: "position invalid",
    44: "driver enable",
}


class Subframe(NamedTuple):
    """Consecutive registers that a frame writes, reads or answers."""

    kind: int  # WRITE, READ or REPLY
    type: int  # INT8, INT16, INT32 or FLOAT
    register: int  # the first one
    length: int  # how many registers
    values: tuple[float, ...] = ()  # empty in a READ


def encode_subframe(kind: int, type_: int, register: int, *values: float, count: int = 0) -> bytes:
    """Return a subframe as bytes.

    Args:
        kind: WRITE, READ or REPLY.
        type_: Type of all values: INT8, INT16, INT32 or FLOAT.
        register: Number of the first register.
        values: Values of a WRITE or REPLY, for consecutive registers.
        count: Number of consecutive registers that a READ requests.
    """
    count = count or len(values)
    header = bytes([kind | type_ << 2 | count])
    if count > 3:  # it does not fit into the two low bits, and follows
        header = bytes([kind | type_ << 2]) + _encode_varuint(count)
    data = b"".join(VALUE_FORMATS[type_].pack(value) for value in values)
    return header + _encode_varuint(register) + data


def decode_subframes(data: bytes) -> Iterator[Subframe]:
    """Yield the subframes of a CAN frame, each a read, write or reply of consecutive registers.

    Args:
        data: Data bytes of the frame.

    Raises:
        ValueError, LookupError, struct.error: A subframe is malformed or of a kind that is not used here.
    """
    offset = 0
    while offset < len(data):
        header = data[offset]
        offset += 1
        if header == PADDING:
            continue
        kind = header & 0xF0
        type_ = header >> 2 & 3
        count = header & 3  # 0 means that the number follows as a varuint
        if kind not in (WRITE, READ, REPLY):
            raise ValueError(f"a part 0x{header:02X}")
        if count == 0:
            count, offset = _decode_varuint(data, offset)
        register, offset = _decode_varuint(data, offset)
        values: list[float] = []
        value_count = 0 if kind == READ else count
        for _ in range(value_count):
            values += VALUE_FORMATS[type_].unpack_from(data, offset)
            offset += VALUE_FORMATS[type_].size
        yield Subframe(kind, type_, register, count, tuple(values))


def make_frame(source: int, destination: int, *subframes: bytes, reply: bool = False) -> CanFrame:
    """Return a frame with these subframes, padded to a data length that CAN FD has.

    Args:
        source: Id of the sender.
        destination: Id of the receiver.
        subframes: Encoded subframes.
        reply: Whether the receiver has to send a reply.
    """
    data = b"".join(subframes)
    length = next(length for length in CAN_FD_DATA_LENGTHS if length >= len(data))
    padded = data.ljust(length, bytes([PADDING]))
    reply_bit = REPLY_REQUESTED_BIT if reply else 0
    return CanFrame(reply_bit | source << 8 | destination, padded)


def split_addresses(frame: CanFrame) -> tuple[int, int]:
    """Return source and destination of a frame."""
    return frame.id >> 8 & 0x7F, frame.id & 0x7F


def _encode_varuint(value: int) -> bytes:
    """Return an unsigned integer in groups of 7 bits, the lowest first; bit 7 is set if another group follows."""
    if value < 0x80:
        return bytes([value])
    return bytes([value & 0x7F | 0x80]) + _encode_varuint(value >> 7)


def _decode_varuint(data: bytes, offset: int) -> tuple[int, int]:
    """Return the unsigned integer that starts at an offset of the data, and the offset after it."""
    value = 0
    shift = 0
    while True:
        byte = data[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, offset
        shift += 7

"""Registers in CAN FD frames: an id is source << 8 | destination, with a bit that asks for a reply; data are parts.

A part writes, reads or answers registers in a row, in one of four types. Written from mjbots' public documentation;
tests hold it against mjbots' own library.
"""

from collections.abc import Iterator
from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from snakesim_can_backend.protocol.definitions import Frame

HOST_ID = 0
LAST_ID = 126
BROADCAST_ID = 127  # every controller takes its frames
REPLY_WANTED = 0x8000
REGISTER_MAP = 5  # the version that this file is of
WRITE, READ, REPLY, NOTHING = 0x00, 0x10, 0x20, 0x50  # high bits of a part
INT8, INT16, INT32, FLOAT = range(4)
TYPES = (Struct("<b"), Struct("<h"), Struct("<i"), Struct("<f"))
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # that CAN FD has


class Register(IntEnum):
    """Those that are used here."""

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


RELATIVE = 0  # home state: the position has no reference
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
    """Registers in a row; length: how many; values: () of a READ."""

    kind: int
    type: int
    register: int
    length: int
    values: tuple[float, ...] = ()


def encode_subframe(kind: int, type_: int, register: int, *values: float, count: int = 0) -> bytes:
    """As bytes. count: of a READ."""
    count = count or len(values)
    head = bytes([kind | type_ << 2 | count]) if count <= 3 else bytes([kind | type_ << 2]) + _varuint(count)
    return head + _varuint(register) + b"".join(TYPES[type_].pack(value) for value in values)


def decode_subframes(data: bytes) -> Iterator[Subframe]:
    """Of a frame. ValueError, LookupError, struct.error: it is malformed, or has parts of another use."""
    at = 0
    while at < len(data):
        head, at = data[at], at + 1
        if head == NOTHING:
            continue
        kind, type_, count = head & 0xF0, head >> 2 & 3, head & 3
        if kind not in (WRITE, READ, REPLY):
            raise ValueError(f"a part 0x{head:02X}")
        if count == 0:
            count, at = _read_varuint(data, at)
        register, at = _read_varuint(data, at)
        values = []
        for _ in range(count if kind != READ else 0):
            values += TYPES[type_].unpack_from(data, at)
            at += TYPES[type_].size
        yield Subframe(kind, type_, register, count, tuple(values))


def make_frame(source: int, destination: int, *parts: bytes, reply: bool = False) -> Frame:
    """A message, filled up to a length that CAN FD has."""
    data = b"".join(parts)
    length = next(length for length in LENGTHS if length >= len(data))
    return Frame((REPLY_WANTED if reply else 0) | source << 8 | destination, data.ljust(length, bytes([NOTHING])))


def split_addresses(frame: Frame) -> tuple[int, int]:
    """Source and destination."""
    return frame.id >> 8 & 0x7F, frame.id & 0x7F


def _varuint(value: int) -> bytes:
    return bytes([value]) if value < 0x80 else bytes([value & 0x7F | 0x80]) + _varuint(value >> 7)


def _read_varuint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte, at = data[at], at + 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7

"""Packets of Feetech's protocol for STS and SMS servos as bytes, both ways. Pure.

    FF FF | id | length | instruction, or error of a status | parameters | checksum

The length counts from the instruction on, with the checksum. The checksum is the complement of the sum from the id on.
Words are little-endian. An instruction and a status have the same form, so a decoder is for one direction.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar

from snakesim_serial_backend.stream_decoder import StreamDecoder

HEADER = b"\xff\xff"
PREFIX_BYTES = 4  # instruction and parameters: header, id, length
MIN_LENGTH = 2  # of an instruction without parameters, with its checksum
MAX_LENGTH = 250
OVERHEAD = 6  # bytes around the parameters
BROADCAST_ID = 0xFE  # id of a packet to all servos
LAST_ID = 253
SIGN_BIT = 15  # of positions and speeds: sign and magnitude
LOAD_SIGN_BIT = 10
OFFSET_SIGN_BIT = 11


class FeetechInstruction(IntEnum):
    """What a packet requests."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class ServoError(IntFlag):
    """The bits of a status' error, and of the register 65.

    Source: the maker's SDK, `ERRBIT_` in its packet handler.
    """

    VOLTAGE = 0x01
    ANGLE_SENSOR = 0x02
    OVERHEATING = 0x04
    OVERCURRENT = 0x08
    OVERLOAD = 0x20


@dataclass(frozen=True)
class FeetechPacket:
    """One packet."""

    id: int
    code: int  # an instruction, or the error of a status
    parameters: bytes

    @property
    def error(self) -> int:
        """The error of a status, bits of `ServoError`; 0 for none."""
        return self.code

    @property
    def data(self) -> bytes:
        """The data of a status."""
        return self.parameters


def checksum(data: bytes) -> int:
    """Return the checksum of the bytes between header and checksum."""
    return ~sum(data) & 0xFF


def encode_packet(id_: int, code: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a packet. code: an instruction, or the error of a status."""
    body = bytes([id_, len(parameters) + MIN_LENGTH, code]) + parameters
    return HEADER + body + bytes([checksum(body)])


def encode_sync_read(ids: Sequence[int], address: int, size: int) -> bytes:
    """Return a packet that reads the same registers of several servos; they answer in this order."""
    return encode_packet(BROADCAST_ID, FeetechInstruction.SYNC_READ, bytes([address, size, *ids]))


def encode_sync_write(address: int, data_by_id: Sequence[tuple[int, bytes]]) -> bytes:
    """Return a packet that writes the same registers of several servos, which do not answer.

    data_by_id: id and data of each servo, all equally long.
    """
    _, first_data = data_by_id[0]
    values = b"".join(bytes([id_]) + data for id_, data in data_by_id)
    return encode_packet(
        BROADCAST_ID, FeetechInstruction.SYNC_WRITE, bytes([address, len(first_data)]) + values
    )


def decode_sign_magnitude(word: int, sign_bit: int) -> int:
    """Return the value of a register that has a sign bit above its magnitude."""
    magnitude = word & ((1 << sign_bit) - 1)
    if word >> sign_bit & 1:
        return -magnitude
    return magnitude


def encode_sign_magnitude(value: int, sign_bit: int) -> int:
    """Return the register of a value: the inverse of `decode_sign_magnitude`."""
    if value < 0:
        return -value | 1 << sign_bit
    return value


class FeetechDecoder(StreamDecoder[FeetechPacket]):
    """Finds packets in a stream of bytes; noise, and packets with a wrong checksum, are skipped."""

    header: ClassVar[bytes] = HEADER
    bytes_before: ClassVar[int] = PREFIX_BYTES

    def read_length(self, start: bytes) -> int | None:
        length = start[3]
        if start[2] > BROADCAST_ID or not MIN_LENGTH <= length <= MAX_LENGTH:
            return None
        return PREFIX_BYTES + length

    def decode(self, data: bytes) -> FeetechPacket | None:
        if checksum(data[2:-1]) != data[-1]:
            return None
        return FeetechPacket(data[2], data[4], data[5:-1])

    def feed_statuses(self, data: bytes) -> Iterator[FeetechPacket]:
        """Add received bytes, and yield the statuses that are complete now: all packets to the driver."""
        return self.feed(data)

"""Packets of Feetech's protocol for STS and SMS servos as bytes, both ways. Pure.

    FF FF | id | length | instruction, or error of a status | parameters | checksum

The length counts from the instruction on, with the checksum. The checksum is the complement of the sum from the id on.
Words are little-endian. An instruction and a status have the same form, so a decoder is for one direction.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

HEADER = b"\xff\xff"
BYTES_BEFORE = 4  # instruction and parameters: header, id, length
MIN_LENGTH = 2  # of an instruction without parameters, with its checksum
MAX_LENGTH = 250
OVERHEAD = 6  # bytes around the parameters
EVERYBODY = 0xFE  # id of a packet to all servos
LAST_ID = 253
SIGN_BIT = 15  # of positions and speeds: sign and magnitude
LOAD_SIGN_BIT = 10
OFFSET_SIGN_BIT = 11


class Instruction(IntEnum):
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
class Packet:
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


def encode(id_: int, code: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a packet. code: an instruction, or the error of a status."""
    inside = bytes([id_, len(parameters) + MIN_LENGTH, code]) + parameters
    return HEADER + inside + bytes([checksum(inside)])


def encode_sync_read(ids: Sequence[int], address: int, size: int) -> bytes:
    """Return a packet that reads the same registers of several servos; they answer in this order."""
    return encode(EVERYBODY, Instruction.SYNC_READ, bytes([address, size, *ids]))


def encode_sync_write(address: int, data_of_ids: Sequence[tuple[int, bytes]]) -> bytes:
    """Return a packet that writes the same registers of several servos, which do not answer.

    data_of_ids: id and data of each servo, all equally long.
    """
    _, first_data = data_of_ids[0]
    values = b"".join(bytes([id_]) + data for id_, data in data_of_ids)
    return encode(EVERYBODY, Instruction.SYNC_WRITE, bytes([address, len(first_data)]) + values)


def to_signed(word: int, sign_bit: int) -> int:
    """Return the value of a register that has a sign bit above its magnitude."""
    magnitude = word & ((1 << sign_bit) - 1)
    if word >> sign_bit & 1:
        return -magnitude
    return magnitude


def from_signed(value: int, sign_bit: int) -> int:
    """Return the register of a value: the inverse of `to_signed`."""
    if value < 0:
        return -value | 1 << sign_bit
    return value


class Decoder:
    """Finds packets in a stream of bytes; noise, and packets with a wrong checksum, are skipped."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.skipped = 0  # bytes

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take in bytes, and yield the packets that are complete now."""
        self._bytes += data
        while True:
            self._skip_to_header()
            length = self._find_length()
            if length is None or len(self._bytes) < length:
                return
            packet = bytes(self._bytes[:length])
            if checksum(packet[2:-1]) != packet[-1]:
                self._skip(1)
                continue
            del self._bytes[:length]
            yield Packet(packet[2], packet[4], packet[5:-1])

    feed_statuses = feed

    @property
    def garbled(self) -> bool:
        """Whether bytes have arrived that are no packet."""
        return self.skipped > 0 or len(self._bytes) > 0

    def _skip_to_header(self) -> None:
        """Skip bytes up to the next header, or up to a byte that may be the begin of one."""
        start = self._bytes.find(HEADER)
        if start < 0:
            start = len(self._bytes) - (1 if self._bytes.endswith(HEADER[:1]) else 0)
        self._skip(start)

    def _find_length(self) -> int | None:
        """Return the length of the packet at the begin of the bytes; None if more bytes are needed to know it.

        A header that is followed by an impossible id or length is skipped.
        """
        while len(self._bytes) >= BYTES_BEFORE and self._bytes.startswith(HEADER):
            length = self._bytes[3]
            if self._bytes[2] <= EVERYBODY and MIN_LENGTH <= length <= MAX_LENGTH:
                return BYTES_BEFORE + length
            self._skip(1)
            self._skip_to_header()
        return None

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._bytes[:count]

"""Packets of protocol 2.0 as bytes, both ways: header, length, byte stuffing, CRC-16. Pure.

    FF FF FD 00 | id | length (2) | instruction | parameters | CRC (2)          length counts from the instruction on

FF FF FD among instruction and parameters is followed by one more FD. The answer to a fast sync read is one packet that
all servos write in turn, each its error, id, data, and the CRC of all bytes up to there; it is not stuffed. Written
from ROBOTIS' public documentation; tests hold it against their SDK.
"""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar

from snakesim_serial_backend.stream_decoder import StreamDecoder

HEADER = b"\xff\xff\xfd\x00"
PLAIN = b"\xff\xff\xfd"  # the begin of a header, which must not occur among the parameters
STUFFED = b"\xff\xff\xfd\xfd"  # what is sent in its place
BYTES_BEFORE = 7  # instruction and parameters: header, id, length
BYTES_AFTER = 2  # instruction and parameters: CRC
MAX_PACKET_BYTES = 1024
EVERYBODY = 0xFE  # id of a packet to all servos
LAST_ID = 252
ALERT = 0x80  # bit of a status' error: there is a hardware error
POLYNOMIAL = 0x8005  # of the CRC
PART_OVERHEAD = 4  # bytes of a servo's part in a fast status around its data: error, id, CRC


class Instruction(IntEnum):
    """What a packet requests; STATUS is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class Refusal(IntEnum):
    """Why a servo did not execute an instruction: the error of a status, without the alert."""

    FAILED = 1
    INSTRUCTION = 2
    CRC = 3
    RANGE = 4
    LENGTH = 5
    LIMIT = 6
    ACCESS = 7


@dataclass(frozen=True)
class Packet:
    """One packet; a status' first parameter is its error."""

    id: int
    instruction: int
    parameters: bytes

    @property
    def error(self) -> int:
        """The error of a status, without the alert; 0 for none."""
        return self.parameters[0] & ~ALERT

    @property
    def alert(self) -> bool:
        """Whether a servo reports in its status that there is a hardware error."""
        return bool(self.parameters[0] & ALERT)

    @property
    def data(self) -> bytes:
        """The data of a status."""
        return self.parameters[1:]


def _make_crc_table() -> list[int]:
    """Return the CRC-16 of every single byte."""
    table: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc <<= 1
            if crc & 0x10000:
                crc ^= POLYNOMIAL
            crc &= 0xFFFF
        table.append(crc)
    return table


_CRC_TABLE = _make_crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC-16 of bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def encoded(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a packet."""
    inside = (bytes([instruction]) + parameters).replace(PLAIN, STUFFED)
    packet = HEADER + struct.pack("<BH", id_, len(inside) + BYTES_AFTER) + inside
    return packet + struct.pack("<H", crc16(packet))


def read_request(id_: int, address: int, size: int) -> bytes:
    """Return a packet that reads registers of one servo."""
    return encoded(id_, Instruction.READ, struct.pack("<HH", address, size))


def sync_read_request(ids: Sequence[int], address: int, size: int, *, fast: bool) -> bytes:
    """Return a packet that reads the same registers of several servos; they answer in this order."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return encoded(EVERYBODY, instruction, struct.pack("<HH", address, size) + bytes(ids))


def sync_write(address: int, data_of_ids: Sequence[tuple[int, bytes]]) -> bytes:
    """Return a packet that writes the same registers of several servos, which do not answer.

    data_of_ids: id and data of each servo, all equally long.
    """
    _, first_data = data_of_ids[0]
    values = b"".join(bytes([id_]) + data for id_, data in data_of_ids)
    return encoded(EVERYBODY, Instruction.SYNC_WRITE, struct.pack("<HH", address, len(first_data)) + values)


def fast_status(parts: Sequence[tuple[int, int, bytes]], requested: int) -> bytes:
    """Return the answer to a fast sync read.

    Args:
        parts: error, id and data of each servo that answers.
        requested: number of servos in the request, which decides the length in the header.
    """
    _, _, first_data = parts[0]
    part_size = len(first_data) + PART_OVERHEAD
    packet = HEADER + struct.pack("<BHB", EVERYBODY, 1 + requested * part_size, Instruction.STATUS)
    for error, id_, data in parts:
        packet += bytes([error, id_]) + data
        packet += struct.pack("<H", crc16(packet))
    return packet


class Decoder(StreamDecoder[Packet]):
    """Finds packets in a stream of bytes; noise, and packets with a wrong CRC, are skipped."""

    header: ClassVar[bytes] = HEADER
    bytes_before: ClassVar[int] = BYTES_BEFORE

    def read_length(self, start: bytes) -> int | None:
        length = BYTES_BEFORE + struct.unpack_from("<H", start, 5)[0]
        if not BYTES_BEFORE + 1 + BYTES_AFTER <= length <= MAX_PACKET_BYTES:
            return None
        return length

    def decode(self, data: bytes) -> Packet | None:
        """Return the packet that these bytes are; None for a wrong CRC, or a status without an error."""
        (crc,) = struct.unpack("<H", data[-BYTES_AFTER:])
        if crc16(data[:-BYTES_AFTER]) != crc:
            return None
        id_ = data[4]
        inside = data[BYTES_BEFORE:-BYTES_AFTER]
        if id_ == EVERYBODY and inside[0] == Instruction.STATUS:
            # A fast status is not stuffed. Its last CRC belongs to the last servo's part.
            return Packet(id_, inside[0], data[BYTES_BEFORE + 1 :])
        inside = inside.replace(STUFFED, PLAIN)
        if inside[0] == Instruction.STATUS and len(inside) == 1:
            return None
        return Packet(id_, inside[0], inside[1:])

    def feed_statuses(self, data: bytes) -> Iterator[Packet]:
        """Take in bytes, and yield the statuses that are complete now."""
        return (packet for packet in self.feed(data) if packet.instruction == Instruction.STATUS)


def fast_parts(packet: Packet, size: int) -> list[Packet]:
    """Return the statuses in the answer to a fast sync read of `size` bytes each.

    Only the packet's own CRC has been checked, which covers all parts.
    """
    part_size = size + PART_OVERHEAD
    statuses: list[Packet] = []
    for start in range(0, len(packet.parameters), part_size):
        part = packet.parameters[start : start + part_size]
        if len(part) == part_size:
            statuses.append(_part_status(part))
    return statuses


def intact_parts(data: bytes, size: int) -> list[Packet]:
    """Return the statuses that are intact in a fast answer that ends early, or is garbled from some servo on."""
    start = data.find(HEADER + bytes([EVERYBODY]))
    if start < 0:
        return []
    packet = data[start:]
    part_size = size + PART_OVERHEAD
    statuses: list[Packet] = []
    for start in range(BYTES_BEFORE + 1, len(packet) - part_size + 1, part_size):
        end = start + part_size
        (crc,) = struct.unpack("<H", packet[end - 2 : end])
        if crc16(packet[: end - 2]) != crc:
            break
        statuses.append(_part_status(packet[start:end]))
    return statuses


def _part_status(part: bytes) -> Packet:
    """Return one servo's part of a fast status as a status of its own: error, id, data, CRC."""
    error = part[:1]
    id_ = part[1]
    data = part[2:-2]
    return Packet(id_, Instruction.STATUS, error + data)

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
HEADER_PREFIX = b"\xff\xff\xfd"  # the start of a header, which must not occur among the parameters
STUFFED_HEADER_PREFIX = b"\xff\xff\xfd\xfd"  # what is sent in its place
PREFIX_BYTES = 7  # instruction and parameters: header, id, length
SUFFIX_BYTES = 2  # instruction and parameters: CRC
MAX_PACKET_BYTES = 1024
BROADCAST_ID = 0xFE  # id of a packet to all servos
LAST_ID = 252
ALERT = 0x80  # bit of a status' error: there is a hardware error
POLYNOMIAL = 0x8005  # of the CRC
PART_OVERHEAD = 4  # bytes of a servo's part in a fast status around its data: error, id, CRC


class DynamixelInstruction(IntEnum):
    """What a packet requests; STATUS is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class DynamixelErrorCode(IntEnum):
    """Why a servo did not execute an instruction: the error of a status, without the alert."""

    FAILED = 1
    INSTRUCTION = 2
    CRC = 3
    RANGE = 4
    LENGTH = 5
    LIMIT = 6
    ACCESS = 7


@dataclass(frozen=True)
class DynamixelPacket:
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


def encode_packet(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a packet."""
    body = (bytes([instruction]) + parameters).replace(HEADER_PREFIX, STUFFED_HEADER_PREFIX)
    packet = HEADER + struct.pack("<BH", id_, len(body) + SUFFIX_BYTES) + body
    return packet + struct.pack("<H", crc16(packet))


def encode_read_request(id_: int, address: int, size: int) -> bytes:
    """Return a packet that reads registers of one servo."""
    return encode_packet(id_, DynamixelInstruction.READ, struct.pack("<HH", address, size))


def encode_sync_read_request(ids: Sequence[int], address: int, size: int, *, fast: bool) -> bytes:
    """Return a packet that reads the same registers of several servos; they answer in this order."""
    instruction = DynamixelInstruction.FAST_SYNC_READ if fast else DynamixelInstruction.SYNC_READ
    return encode_packet(BROADCAST_ID, instruction, struct.pack("<HH", address, size) + bytes(ids))


def encode_sync_write(address: int, data_by_id: Sequence[tuple[int, bytes]]) -> bytes:
    """Return a packet that writes the same registers of several servos, which do not answer.

    data_by_id: id and data of each servo, all equally long.
    """
    _, first_data = data_by_id[0]
    values = b"".join(bytes([id_]) + data for id_, data in data_by_id)
    return encode_packet(
        BROADCAST_ID,
        DynamixelInstruction.SYNC_WRITE,
        struct.pack("<HH", address, len(first_data)) + values,
    )


def encode_fast_status(parts: Sequence[tuple[int, int, bytes]], requested: int) -> bytes:
    """Return the answer to a fast sync read.

    Args:
        parts: Error, id and data of each servo that answers.
        requested: Number of servos in the request, which decides the length in the header.
    """
    _, _, first_data = parts[0]
    part_size = len(first_data) + PART_OVERHEAD
    packet = HEADER + struct.pack(
        "<BHB", BROADCAST_ID, 1 + requested * part_size, DynamixelInstruction.STATUS
    )
    for error, id_, data in parts:
        packet += bytes([error, id_]) + data
        packet += struct.pack("<H", crc16(packet))
    return packet


class DynamixelDecoder(StreamDecoder[DynamixelPacket]):
    """Finds packets in a stream of bytes; noise, and packets with a wrong CRC, are skipped."""

    header: ClassVar[bytes] = HEADER
    bytes_before: ClassVar[int] = PREFIX_BYTES

    def read_length(self, start: bytes) -> int | None:
        length = PREFIX_BYTES + struct.unpack_from("<H", start, 5)[0]
        if not PREFIX_BYTES + 1 + SUFFIX_BYTES <= length <= MAX_PACKET_BYTES:
            return None
        return length

    def decode(self, data: bytes) -> DynamixelPacket | None:
        """Return the packet that these bytes are; None for a wrong CRC, or a status without an error."""
        (crc,) = struct.unpack("<H", data[-SUFFIX_BYTES:])
        if crc16(data[:-SUFFIX_BYTES]) != crc:
            return None
        id_ = data[4]
        body = data[PREFIX_BYTES:-SUFFIX_BYTES]
        if id_ == BROADCAST_ID and body[0] == DynamixelInstruction.STATUS:
            # A fast status is not stuffed. Its last CRC belongs to the last servo's part.
            return DynamixelPacket(id_, body[0], data[PREFIX_BYTES + 1 :])
        body = body.replace(STUFFED_HEADER_PREFIX, HEADER_PREFIX)
        if body[0] == DynamixelInstruction.STATUS and len(body) == 1:
            return None
        return DynamixelPacket(id_, body[0], body[1:])

    def feed_statuses(self, data: bytes) -> Iterator[DynamixelPacket]:
        """Add received bytes, and yield the statuses that are complete now."""
        return (
            packet
            for packet in self.feed(data)
            if packet.instruction == DynamixelInstruction.STATUS
        )


def split_fast_status(packet: DynamixelPacket, size: int) -> list[DynamixelPacket]:
    """Return the statuses in the answer to a fast sync read of `size` bytes each.

    Only the packet's own CRC has been checked, which covers all parts.
    """
    part_size = size + PART_OVERHEAD
    statuses: list[DynamixelPacket] = []
    for start in range(0, len(packet.parameters), part_size):
        part = packet.parameters[start : start + part_size]
        if len(part) == part_size:
            statuses.append(_decode_fast_status_part(part))
    return statuses


def split_damaged_fast_status(data: bytes, size: int) -> list[DynamixelPacket]:
    """Return the statuses that are intact in a fast answer that ends early, or is garbled from some servo on."""
    start = data.find(HEADER + bytes([BROADCAST_ID]))
    if start < 0:
        return []
    packet = data[start:]
    part_size = size + PART_OVERHEAD
    statuses: list[DynamixelPacket] = []
    for start in range(PREFIX_BYTES + 1, len(packet) - part_size + 1, part_size):
        end = start + part_size
        (crc,) = struct.unpack("<H", packet[end - 2 : end])
        if crc16(packet[: end - 2]) != crc:
            break
        statuses.append(_decode_fast_status_part(packet[start:end]))
    return statuses


def _decode_fast_status_part(part: bytes) -> DynamixelPacket:
    """Return one servo's part of a fast status as a status of its own: error, id, data, CRC."""
    error = part[:1]
    id_ = part[1]
    data = part[2:-2]
    return DynamixelPacket(id_, DynamixelInstruction.STATUS, error + data)

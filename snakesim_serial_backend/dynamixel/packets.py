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

HEADER = b"\xff\xff\xfd\x00"
STUFFED, PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
BEFORE, AFTER = 7, 2  # bytes around instruction and parameters
LONGEST = 1024
EVERYBODY = 0xFE
LAST_ID = 252
ALERT = 0x80  # bit of a status' error: look at the hardware error
POLYNOMIAL = 0x8005


class Instruction(IntEnum):
    """What a packet asks for; STATUS is an answer."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A


class Refusal(IntEnum):
    """Why a servo did not do what it was told: the error of a status, without the alert."""

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
        """Of a status."""
        return self.parameters[0] & ~ALERT

    @property
    def alert(self) -> bool:
        """Whether a servo says in its status that there is a hardware error."""
        return bool(self.parameters[0] & ALERT)

    @property
    def data(self) -> bytes:
        """Of a status."""
        return self.parameters[1:]


def _crc_table() -> list[int]:
    table: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ POLYNOMIAL if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return table


_CRC = _crc_table()


def crc16(data: bytes) -> int:
    """Checksum of bytes."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC[crc >> 8 ^ byte]
    return crc


def encoded(id_: int, instruction: int, parameters: bytes = b"") -> bytes:
    """A packet's bytes."""
    inside = (bytes([instruction]) + parameters).replace(PLAIN, STUFFED)
    packet = HEADER + struct.pack("<BH", id_, len(inside) + AFTER) + inside
    return packet + struct.pack("<H", crc16(packet))


def read_request(id_: int, address: int, size: int) -> bytes:
    """Ask one servo for registers."""
    return encoded(id_, Instruction.READ, struct.pack("<HH", address, size))


def sync_read_request(ids: Sequence[int], address: int, size: int, *, fast: bool) -> bytes:
    """Ask several for the same registers; they answer in this order."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return encoded(EVERYBODY, instruction, struct.pack("<HH", address, size) + bytes(ids))


def sync_write(address: int, each: Sequence[tuple[int, bytes]]) -> bytes:
    """Write the same registers of several servos, which do not answer. each: id and data, all equally long."""
    values = b"".join(bytes([id_]) + data for id_, data in each)
    return encoded(EVERYBODY, Instruction.SYNC_WRITE, struct.pack("<HH", address, len(each[0][1])) + values)


def fast_status(parts: Sequence[tuple[int, int, bytes]], of: int) -> bytes:
    """The answer to a fast sync read. parts: error, id and data of those that answer; of: how many were asked."""
    size = len(parts[0][2]) + 4
    packet = HEADER + struct.pack("<BHB", EVERYBODY, 1 + of * size, Instruction.STATUS)
    for error, id_, data in parts:
        packet += bytes([error, id_]) + data
        packet += struct.pack("<H", crc16(packet))
    return packet


class Decoder:
    """Finds packets in a stream of bytes; noise, and packets with a wrong CRC, are skipped."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.skipped = 0  # bytes

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Packets that are whole now."""
        self._bytes += data
        while True:
            self._to_header()
            whole = self._length()
            if whole is None or len(self._bytes) < whole:
                return
            if (packet := self._packet(bytes(self._bytes[:whole]))) is not None:
                del self._bytes[:whole]
                yield packet
            else:
                self._skip(1)

    @property
    def garbled(self) -> bool:
        """Whether bytes have come that are no packet."""
        return self.skipped > 0 or len(self._bytes) > 0

    def _to_header(self) -> None:
        at = self._bytes.find(HEADER)
        if at < 0:  # its beginning may be the end of what has come
            at = max(len(self._bytes) - len(HEADER) + 1, 0)
        self._skip(at)

    def _length(self) -> int | None:
        while len(self._bytes) >= BEFORE and self._bytes.startswith(HEADER):
            whole = BEFORE + struct.unpack_from("<H", self._bytes, 5)[0]
            if BEFORE + 1 + AFTER <= whole <= LONGEST:
                return whole
            self._skip(1)
            self._to_header()
        return None

    def _packet(self, whole: bytes) -> Packet | None:
        if crc16(whole[:-AFTER]) != struct.unpack("<H", whole[-AFTER:])[0]:
            return None
        id_, inside = whole[4], whole[BEFORE:-AFTER]
        if id_ == EVERYBODY and inside[0] == Instruction.STATUS:
            return Packet(id_, inside[0], whole[BEFORE + 1 :])
        inside = inside.replace(STUFFED, PLAIN)
        return Packet(id_, inside[0], inside[1:]) if inside[0] != Instruction.STATUS or len(inside) > 1 else None

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._bytes[:count]


def fast_parts(packet: Packet, size: int) -> list[Packet]:
    """The statuses in the answer to a fast sync read of so many bytes each. The packet's own CRC is right."""
    step = size + 4
    blocks = (packet.parameters[at : at + step] for at in range(0, len(packet.parameters), step))
    return [Packet(block[1], Instruction.STATUS, block[:1] + block[2:-2]) for block in blocks if len(block) == step]


def intact_parts(data: bytes, size: int) -> list[Packet]:
    """Return what is intact of a fast answer that ends early, or is garbled from some servo on, as statuses."""
    start = data.find(HEADER + bytes([EVERYBODY]))
    return list(_parts(data[start:], size)) if start >= 0 else []


def _parts(packet: bytes, size: int) -> Iterator[Packet]:
    step = size + 4
    for at in range(BEFORE + 1, len(packet) - step + 1, step):
        end = at + step
        if crc16(packet[: end - 2]) != struct.unpack("<H", packet[end - 2 : end])[0]:
            return
        yield Packet(packet[at + 1], Instruction.STATUS, packet[at : at + 1] + packet[at + 2 : end - 2])

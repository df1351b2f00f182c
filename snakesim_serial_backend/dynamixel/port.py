"""One serial port with servos: questions with their answers, and writes that nobody answers."""

import struct
from collections.abc import Sequence
from typing import NamedTuple

from snakesim_serial_backend.dynamixel.packets import (
    EVERYBODY,
    LAST_ID,
    Decoder,
    Instruction,
    Packet,
    encoded,
    fast_parts,
    intact_parts,
    read_request,
    sync_read_request,
    sync_write,
)
from snakesim_serial_backend.wire import SerialWire

CHUNK_BYTES = 64  # that an adapter hands on at once
SCAN_S = 0.003  # in which each id may answer a ping of everybody


class Answers(NamedTuple):
    """Everything that came after one question to one servo."""

    statuses: list[Packet]  # of that servo; more than one: two servos have its id, and answer one after the other
    garbled: bool  # bytes came that are no packet: two servos answer at the same time, or the line is disturbed


class Port:
    """Asks one thing after another: the bus is half duplex."""

    def __init__(self, wire: SerialWire, gap_s: float) -> None:
        """gap_s: silence after which no more is expected, besides what bytes and adapter take."""
        self.wire, self._gap_s = wire, gap_s
        self.fast = True  # whether its servos know fast sync reads
        self._heard = bytearray()  # since the newest question

    def ping(self, id_: int) -> Answers:
        """Ask a servo for its model (2 bytes) and firmware; listens for a second answer, too."""
        return self._all_answers(id_, encoded(id_, Instruction.PING))

    def read_alone(self, id_: int, address: int, size: int) -> Answers:
        """Ask a servo for registers, and listen for a second answer."""
        answers = self._all_answers(id_, read_request(id_, address, size))
        return answers._replace(statuses=[one for one in answers.statuses if len(one.data) == size])

    def scan(self) -> list[Packet]:
        """All servos that answer a ping of everybody."""
        gap_s = self._gap_s + LAST_ID * SCAN_S
        return self._packets(Decoder(), encoded(EVERYBODY, Instruction.PING), LAST_ID + 1, gap_s)

    def read(self, id_: int, address: int, size: int) -> Packet | None:
        """Registers of a servo."""
        answer = self._one(id_, read_request(id_, address, size))
        return answer if answer is not None and len(answer.data) == size else None

    def write(self, id_: int, address: int, data: bytes) -> Packet | None:
        """Registers of a servo; its answer says whether it took them."""
        return self._one(id_, encoded(id_, Instruction.WRITE, struct.pack("<H", address) + data))

    def reboot(self, id_: int) -> None:
        """Restart a servo."""
        self._one(id_, encoded(id_, Instruction.REBOOT))

    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, Packet]:
        """The same registers of several servos, of those that answer: who is silent may silence all behind it."""
        if not ids:
            return {}
        decoder, found = Decoder(), list[Packet]()
        request = sync_read_request(ids, address, size, fast=self.fast)
        for packet in self._packets(decoder, request, 1 if self.fast else len(ids), self._gap_s):
            found += fast_parts(packet, size) if packet.id == EVERYBODY else [packet]
        if self.fast and not found:
            found = intact_parts(bytes(self._heard), size)
        return {packet.id: packet for packet in found if packet.id in ids and len(packet.data) == size}

    def write_all(self, address: int, each: Sequence[tuple[int, bytes]]) -> None:
        """The same registers of several servos, at once. Nobody answers."""
        if each:
            self.wire.send(sync_write(address, each))

    # --- inside -----------------------------------------------------------------------------------------------

    def _one(self, id_: int, request: bytes) -> Packet | None:
        answers = self._packets(Decoder(), request, 1, self._gap_s)
        return next((packet for packet in answers if packet.id == id_), None)

    def _all_answers(self, id_: int, request: bytes) -> Answers:
        decoder = Decoder()
        packets = self._packets(decoder, request, 2, self._gap_s)
        return Answers([packet for packet in packets if packet.id == id_], decoder.garbled)

    def _packets(self, decoder: Decoder, request: bytes, answers: int, gap_s: float) -> list[Packet]:
        wire, found = self.wire, list[Packet]()
        self._heard.clear()
        wire.send(request)
        gap_s += wire.time_s(len(request) + CHUNK_BYTES) + wire.latency_s
        while len(found) < answers and (data := wire.receive(gap_s)):
            self._heard += data
            found += [packet for packet in decoder.feed(data) if packet.instruction == Instruction.STATUS]
        return found

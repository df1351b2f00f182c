"""One serial port with servos: requests with their answers, and writes that no servo answers."""

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

CHUNK_BYTES = 64  # that an adapter passes on at once
SCAN_S = 0.003  # in which each id may answer a ping to all


class Answers(NamedTuple):
    """Everything that arrived after one request to one servo."""

    statuses: list[Packet]  # of that servo; more than one: two servos have its id, and answer one after the other
    garbled: bool  # bytes arrived that are no packet: two servos answer at the same time, or the line is disturbed


class Port:
    """Sends one request after another, because the bus is half duplex.

    Attributes:
        wire: the serial port.
        fast: whether its servos support fast sync reads.
    """

    def __init__(self, wire: SerialWire, gap_s: float) -> None:
        """gap_s: silence that ends an answer, besides the time that bytes and adapter take."""
        self.wire = wire
        self.fast = True
        self._gap_s = gap_s
        self._received = bytearray()  # since the newest request

    def ping(self, id_: int) -> Answers:
        """Request the model (2 bytes) and firmware of a servo, and wait for a second answer, too."""
        return self._request_all_answers(id_, encoded(id_, Instruction.PING))

    def read_alone(self, id_: int, address: int, size: int) -> Answers:
        """Read registers of a servo, and wait for a second answer, too."""
        answers = self._request_all_answers(id_, read_request(id_, address, size))
        whole = [status for status in answers.statuses if len(status.data) == size]
        return answers._replace(statuses=whole)

    def scan(self) -> list[Packet]:
        """Return the answers of all servos to a ping to all."""
        gap_s = self._gap_s + LAST_ID * SCAN_S
        return self._request(Decoder(), encoded(EVERYBODY, Instruction.PING), LAST_ID + 1, gap_s)

    def read(self, id_: int, address: int, size: int) -> Packet | None:
        """Read registers of a servo; None without an answer that is complete."""
        status = self._request_one(id_, read_request(id_, address, size))
        if status is None or len(status.data) != size:
            return None
        return status

    def write(self, id_: int, address: int, data: bytes) -> Packet | None:
        """Write registers of a servo, and return its answer; its `error` is 0 if the servo accepted them."""
        return self._request_one(id_, encoded(id_, Instruction.WRITE, struct.pack("<H", address) + data))

    def reboot(self, id_: int) -> None:
        """Restart a servo."""
        self._request_one(id_, encoded(id_, Instruction.REBOOT))

    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, Packet]:
        """Read the same registers of several servos at once.

        Returns:
            The statuses of the servos that answer, by id. A silent servo may silence all behind it.
        """
        if not ids:
            return {}
        request = sync_read_request(ids, address, size, fast=self.fast)
        max_answers = 1 if self.fast else len(ids)  # all servos write one packet together in a fast sync read
        statuses: list[Packet] = []
        for packet in self._request(Decoder(), request, max_answers, self._gap_s):
            if packet.id == EVERYBODY:
                statuses += fast_parts(packet, size)
            else:
                statuses.append(packet)
        if self.fast and not statuses:
            statuses = intact_parts(bytes(self._received), size)
        return {status.id: status for status in statuses if status.id in ids and len(status.data) == size}

    def write_all(self, address: int, data_of_ids: Sequence[tuple[int, bytes]]) -> None:
        """Write the same registers of several servos at once; they do not answer.

        data_of_ids: id and data of each servo, all equally long.
        """
        if data_of_ids:
            self.wire.send(sync_write(address, data_of_ids))

    # --- inside -----------------------------------------------------------------------------------------------

    def _request_one(self, id_: int, request: bytes) -> Packet | None:
        """Send a request to one servo, and return its answer."""
        for status in self._request(Decoder(), request, 1, self._gap_s):
            if status.id == id_:
                return status
        return None

    def _request_all_answers(self, id_: int, request: bytes) -> Answers:
        """Send a request to one servo, and return its answer with all else that arrives."""
        decoder = Decoder()
        statuses = self._request(decoder, request, 2, self._gap_s)
        return Answers([status for status in statuses if status.id == id_], decoder.garbled)

    def _request(self, decoder: Decoder, request: bytes, max_answers: int, gap_s: float) -> list[Packet]:
        """Send a request, and return the statuses that arrive until there are enough or the bus is silent."""
        wire = self.wire
        statuses: list[Packet] = []
        self._received.clear()
        wire.send(request)
        gap_s += wire.time_s(len(request) + CHUNK_BYTES) + wire.latency_s
        while len(statuses) < max_answers:
            data = wire.receive(gap_s)
            if not data:
                break
            self._received += data
            statuses += [packet for packet in decoder.feed(data) if packet.instruction == Instruction.STATUS]
        return statuses

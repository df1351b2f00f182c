"""One serial port with servos: requests with their answers, and writes that no servo answers."""

import struct
from collections.abc import Sequence

from snakesim_serial_backend.dynamixel.packets import (
    EVERYBODY,
    LAST_ID,
    PART_OVERHEAD,
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
from snakesim_serial_backend.request_port import Answers, RequestPort
from snakesim_serial_backend.wire import SerialWire

SCAN_S = 0.003  # in which each id may answer a ping to all
PING_SIZE = 3  # bytes of data in the answer to a ping: model and firmware


class Port(RequestPort[Packet]):
    """The requests of protocol 2.0.

    Attributes:
        fast: whether its servos support fast sync reads.
    """

    def __init__(self, wire: SerialWire, gap_s: float) -> None:
        """gap_s: silence that ends an answer, besides the time that bytes and adapter take."""
        super().__init__(wire, gap_s)
        self.fast = True

    def ping(self, id_: int) -> Answers[Packet]:
        """Request the model (2 bytes) and firmware of a servo."""
        return self._request_all_answers(id_, encoded(id_, Instruction.PING), PING_SIZE, 1)

    def read_alone(self, id_: int, address: int, size: int) -> Answers[Packet]:
        """Read registers of a servo, and wait for a second answer, too."""
        return self._request_all_answers(id_, read_request(id_, address, size), size, 2)

    def scan(self) -> list[Packet]:
        """Return the answers of all servos to a ping to all."""
        gap_s = self._gap_s + LAST_ID * SCAN_S
        return list(self._request(self._make_decoder(), encoded(EVERYBODY, Instruction.PING), gap_s, gap_s))

    def read(self, id_: int, address: int, size: int) -> Packet | None:
        """Read registers of a servo; None without an answer that is complete."""
        return self._request_one(id_, read_request(id_, address, size), size)

    def write(self, id_: int, address: int, data: bytes) -> Packet | None:
        """Write registers of a servo, and return its answer; its `error` is 0 if the servo accepted them."""
        return self._request_one(id_, encoded(id_, Instruction.WRITE, struct.pack("<H", address) + data), 0)

    def reboot(self, id_: int) -> None:
        """Restart a servo."""
        self._request_one(id_, encoded(id_, Instruction.REBOOT), 0)

    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, Packet]:
        """Read the same registers of several servos at once.

        Returns:
            The statuses of the servos that answer, by id. A silent servo may silence all behind it.
        """
        if not ids:
            return {}
        request = sync_read_request(ids, address, size, fast=self.fast)
        statuses = self._request_fast(len(ids), request, size) if self.fast else self._request_each(ids, request, size)
        return {status.id: status for status in statuses if status.id in ids and len(status.data) == size}

    def write_all(self, address: int, data_of_ids: Sequence[tuple[int, bytes]]) -> None:
        """Write the same registers of several servos at once; they do not answer.

        data_of_ids: id and data of each servo, all equally long.
        """
        if data_of_ids:
            self.wire.send(sync_write(address, data_of_ids))

    # --- inside -----------------------------------------------------------------------------------------------

    def _make_decoder(self) -> Decoder:
        return Decoder()

    def _request_fast(self, count: int, request: bytes, size: int) -> list[Packet]:
        """Send a fast sync read, and return the parts of the answer that are intact.

        Args:
            count: number of servos, which write one answer together.
            request: the packet to them.
            size: bytes of data in each part; a packet of another length is a late answer to another request.
        """
        length = count * (size + PART_OVERHEAD)
        for status in self._request(self._make_decoder(), request, self._gap_s, self._gap_s):
            if status.id == EVERYBODY and len(status.parameters) == length:
                return fast_parts(status, size)
            self._match_answer(status.id)
        return intact_parts(bytes(self._received), size)

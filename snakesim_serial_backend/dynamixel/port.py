"""One serial port with servos: requests with their answers, and writes that no servo answers."""

import struct
from collections.abc import Sequence

from snakesim_serial_backend.dynamixel.packets import (
    BROADCAST_ID,
    LAST_ID,
    PART_OVERHEAD,
    DynamixelDecoder,
    DynamixelInstruction,
    DynamixelPacket,
    encode_packet,
    encode_read_request,
    encode_sync_read_request,
    encode_sync_write,
    split_damaged_fast_status,
    split_fast_status,
)
from snakesim_serial_backend.request_port import RequestPort, RequestResponses
from snakesim_serial_backend.wire import SerialWire

SCAN_S = 0.003  # in which each id may answer a ping to all
PING_SIZE = 3  # bytes of data in the answer to a ping: model and firmware


class DynamixelPort(RequestPort[DynamixelPacket]):
    """The requests of protocol 2.0.

    Attributes:
        fast: Whether its servos support fast sync reads.
    """

    def __init__(self, wire: SerialWire, response_gap_s: float) -> None:
        """Create a port on which nothing has been sent yet.

        Args:
            wire: The serial port.
            response_gap_s: Silence that ends an answer, besides the time that bytes and adapter take.
        """
        super().__init__(wire, response_gap_s)
        self.fast = True

    def ping(self, id_: int) -> RequestResponses[DynamixelPacket]:
        """Request the model (2 bytes) and firmware of a servo."""
        return self._request_all_responses(
            id_, encode_packet(id_, DynamixelInstruction.PING), PING_SIZE, 1
        )

    def read_alone(self, id_: int, address: int, size: int) -> RequestResponses[DynamixelPacket]:
        """Read registers of a servo, and wait for a second answer, too."""
        return self._request_all_responses(id_, encode_read_request(id_, address, size), size, 2)

    def scan(self) -> list[DynamixelPacket]:
        """Return the answers of all servos to a ping to all."""
        response_gap_s = self._response_gap_s + LAST_ID * SCAN_S
        return list(
            self._send_request(
                self._make_decoder(),
                encode_packet(BROADCAST_ID, DynamixelInstruction.PING),
                response_gap_s,
                response_gap_s,
            )
        )

    def read(self, id_: int, address: int, size: int) -> DynamixelPacket | None:
        """Read registers of a servo; None without an answer that is complete."""
        return self._request_single_response(id_, encode_read_request(id_, address, size), size)

    def write(self, id_: int, address: int, data: bytes) -> DynamixelPacket | None:
        """Write registers of a servo, and return its answer; its `error` is 0 if the servo accepted them."""
        parameters = struct.pack("<H", address) + data
        return self._request_single_response(
            id_, encode_packet(id_, DynamixelInstruction.WRITE, parameters), 0
        )

    def reboot(self, id_: int) -> None:
        """Restart a servo."""
        self._request_single_response(id_, encode_packet(id_, DynamixelInstruction.REBOOT), 0)

    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, DynamixelPacket]:
        """Read the same registers of several servos at once.

        Returns:
            The statuses of the servos that answer, by id. A silent servo may silence all behind it.
        """
        if not ids:
            return {}
        request = encode_sync_read_request(ids, address, size, fast=self.fast)
        statuses = (
            self._request_fast(len(ids), request, size)
            if self.fast
            else self._sync_read(ids, request, size)
        )
        return {
            status.id: status
            for status in statuses
            if status.id in ids and len(status.data) == size
        }

    def write_all(self, address: int, data_by_id: Sequence[tuple[int, bytes]]) -> None:
        """Write the same registers of several servos at once; they do not answer.

        data_by_id: id and data of each servo, all equally long.
        """
        if data_by_id:
            self.wire.send(encode_sync_write(address, data_by_id))

    # --- inside -----------------------------------------------------------------------------------------------

    def _make_decoder(self) -> DynamixelDecoder:
        return DynamixelDecoder()

    def _request_fast(self, count: int, request: bytes, size: int) -> list[DynamixelPacket]:
        """Send a fast sync read, and return the parts of the answer that are intact.

        Args:
            count: Number of servos, which write one answer together.
            request: The packet to them.
            size: Bytes of data in each part; a packet of another length is a late answer to another request.
        """
        length = count * (size + PART_OVERHEAD)
        for status in self._send_request(
            self._make_decoder(), request, self._response_gap_s, self._response_gap_s
        ):
            if status.id == BROADCAST_ID and len(status.parameters) == length:
                return split_fast_status(status, size)
            self._match_response(status.id)
        return split_damaged_fast_status(bytes(self._received), size)

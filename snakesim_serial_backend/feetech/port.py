"""One serial port with Feetech servos: requests with their answers, and writes that no servo answers."""

from collections.abc import Sequence

from snakesim_serial_backend.feetech.packets import (
    BROADCAST_ID,
    LAST_ID,
    FeetechDecoder,
    FeetechInstruction,
    FeetechPacket,
    encode_packet,
    encode_sync_read,
    encode_sync_write,
)
from snakesim_serial_backend.request_port import RequestPort, RequestResponses

SCAN_S = 0.003  # in which each id may answer a ping to all


class FeetechPort(RequestPort[FeetechPacket]):
    """The requests of Feetech's protocol."""

    def ping(self, id_: int) -> RequestResponses[FeetechPacket]:
        """Request a sign of life of a servo, which has no data."""
        return self._request_all_responses(id_, encode_packet(id_, FeetechInstruction.PING), 0, 1)

    def read_alone(self, id_: int, address: int, size: int) -> RequestResponses[FeetechPacket]:
        """Read registers of a servo, and wait for a second answer, too."""
        return self._request_all_responses(
            id_, encode_packet(id_, FeetechInstruction.READ, bytes([address, size])), size, 2
        )

    def scan(self) -> list[FeetechPacket]:
        """Return the answers of all servos to a ping to all."""
        response_gap_s = self._response_gap_s + LAST_ID * SCAN_S
        return list(
            self._send_request(
                self._make_decoder(),
                encode_packet(BROADCAST_ID, FeetechInstruction.PING),
                response_gap_s,
                response_gap_s,
            )
        )

    def read(self, id_: int, address: int, size: int) -> FeetechPacket | None:
        """Read registers of a servo; None without an answer that is complete."""
        return self._request_single_response(
            id_, encode_packet(id_, FeetechInstruction.READ, bytes([address, size])), size
        )

    def write(self, id_: int, address: int, data: bytes) -> FeetechPacket | None:
        """Write registers of a servo, and return its answer, which does not tell whether it accepted them."""
        return self._request_single_response(
            id_, encode_packet(id_, FeetechInstruction.WRITE, bytes([address]) + data), 0
        )

    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, FeetechPacket]:
        """Read the same registers of several servos at once.

        Returns:
            The statuses of the servos that answer, by id. A silent servo may silence all behind it.
        """
        if not ids:
            return {}
        statuses = self._sync_read(ids, encode_sync_read(ids, address, size), size)
        return {status.id: status for status in statuses}

    def write_all(self, address: int, data_by_id: Sequence[tuple[int, bytes]]) -> None:
        """Write the same registers of several servos at once; they do not answer.

        data_by_id: id and data of each servo, all equally long.
        """
        if data_by_id:
            self.wire.send(encode_sync_write(address, data_by_id))

    def _make_decoder(self) -> FeetechDecoder:
        return FeetechDecoder()

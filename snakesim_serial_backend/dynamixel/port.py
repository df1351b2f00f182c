"""One serial port with servos: requests with their answers, and writes that no servo answers.

An answer may arrive after the wait for it is over: a USB adapter is slow, or a computer pauses. The next request would
then get two answers. So the port remembers the requests that have no answer yet, and counts a late answer for the
oldest of them. Only an answer to which no request belongs shows that a second servo has the same id.
"""

import contextlib
import struct
import time
from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

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
from snakesim_serial_backend.wire import SerialWire

CHUNK_BYTES = 64  # that an adapter passes on at once
SCAN_S = 0.003  # in which each id may answer a ping to all
PATIENT_GAP_S = 0.25  # silence that ends the wait for an answer before the control cycle runs
SECOND_ANSWER_GAP_S = 0.02  # silence that ends the wait for a second answer: a return delay is 0.5 ms at most
IDLE_S = 0.05  # silence after which the line is idle
MAX_DRAIN_S = 1.0  # for a line that never becomes idle
LATE_S = 2.0  # after which an answer does not arrive any more

PING_SIZE = 3  # bytes of data in the answer to a ping: model and firmware


class Answers(NamedTuple):
    """Everything that arrived after one request to one servo."""

    statuses: list[Packet]  # of that servo: answers to this request
    surplus: int  # answers of that servo to which no request belongs: two servos have its id, one answers after another
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
        self._second_gap_s = gap_s
        self._received = bytearray()  # since the newest request
        self._unanswered_s: dict[int, deque[float]] = defaultdict(deque)  # when each servo was asked, the oldest first

    @contextlib.contextmanager
    def wait_patiently(self) -> Iterator[None]:
        """Wait longer for answers, because no control cycle depends on them yet."""
        gap_s = self._gap_s
        second_gap_s = self._second_gap_s
        self._gap_s = max(gap_s, PATIENT_GAP_S)
        self._second_gap_s = max(second_gap_s, SECOND_ANSWER_GAP_S)
        try:
            yield
        finally:
            self._gap_s = gap_s
            self._second_gap_s = second_gap_s

    def wait_until_idle(self) -> None:
        """Receive late answers until the line is idle, and assign them to the requests that they belong to."""
        decoder = Decoder()
        end_s = time.monotonic() + MAX_DRAIN_S
        while time.monotonic() < end_s:
            data = self.wire.receive(IDLE_S)
            if not data:
                return
            for packet in decoder.feed(data):
                if packet.instruction == Instruction.STATUS:
                    self._match_answer(packet.id)

    def ping(self, id_: int) -> Answers:
        """Request the model (2 bytes) and firmware of a servo."""
        return self._request_all_answers(id_, encoded(id_, Instruction.PING), PING_SIZE, 1)

    def read_alone(self, id_: int, address: int, size: int) -> Answers:
        """Read registers of a servo, and wait for a second answer, too."""
        return self._request_all_answers(id_, read_request(id_, address, size), size, 2)

    def scan(self) -> list[Packet]:
        """Return the answers of all servos to a ping to all."""
        gap_s = self._gap_s + LAST_ID * SCAN_S
        return list(self._request(Decoder(), encoded(EVERYBODY, Instruction.PING), gap_s, gap_s))

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

    def _request_one(self, id_: int, request: bytes, size: int) -> Packet | None:
        """Send a request to one servo, and return its answer. size: bytes of data in it."""
        answers = self._request_all_answers(id_, request, size, 1)
        if not answers.statuses:
            return None
        return answers.statuses[0]

    def _request_all_answers(self, id_: int, request: bytes, size: int, max_answers: int) -> Answers:
        """Send a request to one servo, and return its answers.

        Args:
            id_: the servo.
            request: the packet to it.
            size: bytes of data in an answer; others are late answers to other requests.
            max_answers: number of answers after which to stop waiting.
        """
        self._note_request([id_])
        decoder = Decoder()
        statuses: list[Packet] = []
        surplus = 0
        for status in self._request(decoder, request, self._gap_s, self._second_gap_s):
            is_expected = self._match_answer(status.id)
            if status.id != id_:
                continue
            if not is_expected:
                surplus += 1
            if len(status.data) == size:
                statuses.append(status)
            if len(statuses) >= max_answers:
                break
        return Answers(statuses, surplus, decoder.garbled)

    def _request_fast(self, count: int, request: bytes, size: int) -> list[Packet]:
        """Send a fast sync read, and return the parts of the answer that are intact.

        Args:
            count: number of servos, which write one answer together.
            request: the packet to them.
            size: bytes of data in each part; a packet of another length is a late answer to another request.
        """
        length = count * (size + PART_OVERHEAD)
        for status in self._request(Decoder(), request, self._gap_s, self._gap_s):
            if status.id == EVERYBODY and len(status.parameters) == length:
                return fast_parts(status, size)
            self._match_answer(status.id)
        return intact_parts(bytes(self._received), size)

    def _request_each(self, ids: Collection[int], request: bytes, size: int) -> list[Packet]:
        """Send a sync read, and return the answers, of which each servo sends one."""
        self._note_request(ids)
        statuses: list[Packet] = []
        for status in self._request(Decoder(), request, self._gap_s, self._gap_s):
            self._match_answer(status.id)
            if status.id in ids and len(status.data) == size:
                statuses.append(status)
            if len(statuses) >= len(ids):
                break
        return statuses

    def _request(self, decoder: Decoder, request: bytes, gap_s: float, next_gap_s: float) -> Iterator[Packet]:
        """Send a request, and yield the statuses that arrive until the bus is silent.

        Args:
            decoder: of the bytes that arrive.
            request: the packet to send.
            gap_s: silence that ends the wait for the first status.
            next_gap_s: silence that ends the wait for a further one.
        """
        wire = self.wire
        self._received.clear()
        wire.send(request)
        busy_s = wire.time_s(len(request) + CHUNK_BYTES) + wire.latency_s
        while data := wire.receive(gap_s + busy_s):
            self._received += data
            for packet in decoder.feed(data):
                if packet.instruction == Instruction.STATUS:
                    gap_s = next_gap_s
                    yield packet

    def _note_request(self, ids: Collection[int]) -> None:
        """Remember that these servos are being asked."""
        for id_ in ids:
            self._forget_unanswered(id_)
            self._unanswered_s[id_].append(time.monotonic())

    def _match_answer(self, id_: int) -> bool:
        """Assign an answer to the oldest request to a servo without one; return False if there is no such request."""
        if not self._unanswered_s[id_]:
            return False
        self._unanswered_s[id_].popleft()
        return True

    def _forget_unanswered(self, id_: int) -> None:
        """Forget the requests to a servo whose answers do not arrive any more."""
        unanswered_s = self._unanswered_s[id_]
        oldest_s = time.monotonic() - LATE_S
        while unanswered_s and (self.wire.answers_at_once or unanswered_s[0] < oldest_s):
            unanswered_s.popleft()

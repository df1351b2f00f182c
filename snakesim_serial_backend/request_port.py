"""Requests on a half-duplex serial bus, each with its answers, for any protocol.

An answer may arrive after the wait for it is over: a USB adapter is slow, or a computer pauses. The next request would
then get two answers. So the port remembers the requests that have no answer yet, and counts a late answer for the
oldest of them. Only an answer to which no request belongs shows that a second servo has the same id.
"""

import contextlib
import time
from abc import ABC, abstractmethod
from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

from snakesim_serial_backend.wire import SerialWire

CHUNK_BYTES = 64  # that an adapter passes on at once
EXTENDED_GAP_S = 0.25  # silence that ends the wait for an answer before the control cycle runs
# Silence that ends the wait for a second answer: a return delay is 0.5 ms at most.
SECOND_ANSWER_GAP_S = 0.02
IDLE_S = 0.05  # silence after which the line is idle
MAX_DRAIN_S = 1.0  # for a line that never becomes idle
ATTEMPTS = 3  # to read or write registers before the control cycle runs
MAX_RESPONSE_DELAY_S = 2.0  # after which an answer does not arrive any more


class ServoStatus(Protocol):
    """A packet in which a servo answers."""

    @property
    def id(self) -> int:
        """The servo that answers."""
        ...

    @property
    def data(self) -> bytes:
        """The registers in the answer."""
        ...


StatusT = TypeVar("StatusT", bound=ServoStatus)
StatusT_co = TypeVar("StatusT_co", bound=ServoStatus, covariant=True)


class StatusDecoder(Protocol[StatusT_co]):
    """Finds the statuses in a stream of bytes."""

    @property
    def garbled(self) -> bool:
        """Whether bytes have arrived that are no packet."""
        ...

    def feed_statuses(self, data: bytes) -> Iterator[StatusT_co]:
        """Add received bytes, and yield the statuses that are complete now."""
        ...


class RequestResponses(NamedTuple, Generic[StatusT]):
    """Everything that arrived after one request to one servo."""

    statuses: list[StatusT]  # of that servo: answers to this request
    # Answers of that servo to which no request belongs: two servos have its id, one answers after another.
    surplus_count: int
    garbled: bool  # bytes arrived that are no packet: two servos answer at the same time, or the line is disturbed


class RequestPort(ABC, Generic[StatusT]):
    """Sends one request after another, because the bus is half duplex. A protocol derives its port from it.

    Attributes:
        wire: The serial port.
    """

    def __init__(self, wire: SerialWire, response_gap_s: float) -> None:
        """Create a port on which nothing has been sent yet.

        Args:
            wire: The serial port.
            response_gap_s: Silence that ends an answer, besides the time that bytes and adapter take.
        """
        self.wire = wire
        self._response_gap_s = response_gap_s
        self._next_response_gap_s = response_gap_s
        self._received = bytearray()  # since the newest request
        # When each servo was asked, the oldest first.
        self._pending_request_times_s: dict[int, deque[float]] = defaultdict(deque)

    @abstractmethod
    def _make_decoder(self) -> StatusDecoder[StatusT]:
        """Return a decoder that has received no bytes yet."""

    @abstractmethod
    def read_alone(self, id_: int, address: int, size: int) -> RequestResponses[StatusT]:
        """Read registers of a servo, and wait for a second answer, too."""

    @abstractmethod
    def read(self, id_: int, address: int, size: int) -> StatusT | None:
        """Read registers of a servo; None without an answer that is complete."""

    @abstractmethod
    def read_all(self, ids: Sequence[int], address: int, size: int) -> dict[int, StatusT]:
        """Read the same registers of several servos at once.

        Returns:
            The statuses of the servos that answer, by id. A silent servo may silence all behind it.
        """

    @abstractmethod
    def write(self, id_: int, address: int, data: bytes) -> StatusT | None:
        """Write registers of a servo, and return its answer; its `error` is 0 if the servo accepted them."""

    @abstractmethod
    def write_all(self, address: int, data_by_id: Sequence[tuple[int, bytes]]) -> None:
        """Write the same registers of several servos at once; they do not answer.

        data_by_id: id and data of each servo, all equally long.
        """

    def try_to_read(self, id_: int, address: int, size: int) -> StatusT | None:
        """Read registers of a servo, several times if need be; None without an answer."""
        for _ in range(ATTEMPTS):
            status = self.read(id_, address, size)
            if status is not None:
                return status
        return None

    @contextlib.contextmanager
    def extended_timeouts(self) -> Iterator[None]:
        """Wait longer for responses within this context, in which no control cycle depends on them yet."""
        response_gap_s = self._response_gap_s
        next_response_gap_s = self._next_response_gap_s
        self._response_gap_s = max(response_gap_s, EXTENDED_GAP_S)
        self._next_response_gap_s = max(next_response_gap_s, SECOND_ANSWER_GAP_S)
        try:
            yield
        finally:
            self._response_gap_s = response_gap_s
            self._next_response_gap_s = next_response_gap_s

    def wait_until_idle(self) -> None:
        """Receive late answers until the line is idle, and assign them to the requests that they belong to."""
        decoder = self._make_decoder()
        deadline_s = time.monotonic() + MAX_DRAIN_S
        while time.monotonic() < deadline_s:
            data = self.wire.receive(IDLE_S)
            if not data:
                return
            for packet in decoder.feed_statuses(data):
                self._match_response(packet.id)

    # --- inside -----------------------------------------------------------------------------------------------

    def _request_single_response(self, id_: int, request: bytes, size: int) -> StatusT | None:
        """Send a request to one servo, and return its answer. size: bytes of data in it."""
        responses = self._request_all_responses(id_, request, size, 1)
        if not responses.statuses:
            return None
        return responses.statuses[0]

    def _request_all_responses(
        self, id_: int, request: bytes, size: int, max_responses: int
    ) -> RequestResponses[StatusT]:
        """Send a request to one servo, and return all responses that arrive until the bus is silent.

        Args:
            id_: Id of the servo.
            request: Encoded request packet.
            size: Number of data bytes in a response; responses of another length are late ones to other requests.
            max_responses: Number of responses after which to stop waiting.
        """
        self._record_request([id_])
        decoder = self._make_decoder()
        statuses: list[StatusT] = []
        surplus_count = 0
        for status in self._send_request(
            decoder, request, self._response_gap_s, self._next_response_gap_s
        ):
            is_expected = self._match_response(status.id)
            if status.id != id_:
                continue
            if not is_expected:
                surplus_count += 1
            if len(status.data) == size:
                statuses.append(status)
            if len(statuses) >= max_responses:
                break
        return RequestResponses(statuses, surplus_count, decoder.garbled)

    def _sync_read(self, ids: Collection[int], request: bytes, size: int) -> list[StatusT]:
        """Send a sync read, and return the answers, of which each servo sends one.

        A servo that seems to answer twice is left out, so that the driver reads it alone, and finds why.
        """
        self._record_request(ids)
        doubled_ids: set[int] = set()
        statuses: list[StatusT] = []
        for status in self._send_request(
            self._make_decoder(), request, self._response_gap_s, self._response_gap_s
        ):
            if not self._match_response(status.id):
                doubled_ids.add(status.id)
            elif status.id in ids and len(status.data) == size:
                statuses.append(status)
            if len(statuses) >= len(ids):
                break
        return [status for status in statuses if status.id not in doubled_ids]

    def _send_request(
        self,
        decoder: StatusDecoder[StatusT],
        request: bytes,
        response_gap_s: float,
        next_response_gap_s: float,
    ) -> Iterator[StatusT]:
        """Send a request, and yield the statuses that arrive until the bus is silent.

        Args:
            decoder: Decoder of the received bytes.
            request: Encoded request packet.
            response_gap_s: Silence that ends the wait for the first status.
            next_response_gap_s: Silence that ends the wait for a further status.
        """
        wire = self.wire
        self._received.clear()
        wire.send(request)
        transmission_s = wire.compute_transmission_s(len(request) + CHUNK_BYTES) + wire.latency_s
        while data := wire.receive(response_gap_s + transmission_s):
            self._received += data
            for status in decoder.feed_statuses(data):
                response_gap_s = next_response_gap_s
                yield status

    def _record_request(self, ids: Collection[int]) -> None:
        """Remember that these servos are being asked."""
        for id_ in ids:
            self._forget_expired_requests(id_)
            self._pending_request_times_s[id_].append(time.monotonic())

    def _match_response(self, id_: int) -> bool:
        """Assign an answer to the oldest request to a servo without one; return False if there is no such request."""
        if not self._pending_request_times_s[id_]:
            return False
        self._pending_request_times_s[id_].popleft()
        return True

    def _forget_expired_requests(self, id_: int) -> None:
        """Forget the requests to a servo whose answers do not arrive any more."""
        pending_request_times_s = self._pending_request_times_s[id_]
        oldest_s = time.monotonic() - MAX_RESPONSE_DELAY_S
        while pending_request_times_s and (
            self.wire.has_immediate_responses or pending_request_times_s[0] < oldest_s
        ):
            pending_request_times_s.popleft()

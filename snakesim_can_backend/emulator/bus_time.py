"""Emulates the timing of a bus, for frames on a bus without a bit rate.

Every frame takes as long as with the maximum of stuff bits. Each module's frames wait in their own order; whenever the
bus is free, the lowest id among the first frames of all modules wins it. The host's frames are seen only after they
have arrived: they take their time on the bus, but cannot be delayed. A newer frame of a module replaces an unsent one
with the same id, as in a transmit mailbox of firmware, so that no queue grows for ever.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf

from snakesim_can_backend.bus.load import BIT_RATE, compute_max_frame_bits
from snakesim_can_backend.protocol.definitions import NODE_BITS, CanFrame, Opcode

OPCODE_COUNT = 32  # an opcode has five bits
ID_BITS = 11
MAX_DATA_BYTES = 8  # on classic CAN
MAX_AHEAD_US = 20_000.0  # of frames that the host sends faster than any bus could carry
# Each answers another question: none replaces another.
UNREPLACEABLE_OPCODES = frozenset((Opcode.PARAMETER_ANSWER,))
MAX_WAITING_RESPONSES = 64  # that wait at once


@dataclass(frozen=True)
class BusTraffic:
    """Traffic of a bus up to a point in time, by opcode."""

    now_us: float
    frames: tuple[int, ...]  # by opcode
    busy_us: tuple[float, ...]  # by opcode
    replaced: int  # frames that were replaced by newer ones before the bus was free
    late_us: float  # the longest that a frame waited for the bus

    def load_since(self, before: "BusTraffic") -> float:
        """Return the load of the bus since an earlier point, as a fraction of time."""
        duration_us = self.now_us - before.now_us
        if duration_us <= 0:
            return 0.0
        return (sum(self.busy_us) - sum(before.busy_us)) / duration_us


class BusTime:
    """The timing of one bus. Times are microseconds, and must not go backward."""

    def __init__(self, bit_rate: int = BIT_RATE) -> None:
        """Create a simulated CAN bus that is idle.

        Frames wait for arbitration, and occupy the bus for their worst-case time.

        Args:
            bit_rate: Bit rate of the bus in bit/s.
        """
        self.frame_duration_us_by_length = [
            compute_max_frame_bits(length) * 1e6 / bit_rate for length in range(MAX_DATA_BYTES + 1)
        ]

        # Frames that wait, each with the time since which it waits.
        self._waiting_frame_by_mailbox_by_sender: dict[int, dict[int, tuple[CanFrame, float]]] = {}
        # Heap of (id, sender, mailbox) of the first frame of every sender: the lowest id wins the arbitration.
        self._arbitration_heap: list[tuple[int, int, int]] = []
        # Frames of UNREPLACEABLE_OPCODES so far; each gets a mailbox of its own.
        self._response_count = 0
        # The frame that a defective sender (a "babbling idiot") repeats without a pause.
        self._babble_frame_by_sender: dict[int, CanFrame] = {}

        # The bus.
        self._bus_free_us = 0.0  # when the bus will be free
        # The frame on the bus, and its end.
        self._transmission: tuple[CanFrame, float] | None = None
        self._sent_frames: list[CanFrame] = []

        # Statistics.
        self._frame_count_by_opcode = [0] * OPCODE_COUNT
        self._busy_us_by_opcode = [0.0] * OPCODE_COUNT
        self._replaced_count = 0
        self._max_wait_us = 0.0

    def record_host_frame(self, frame: CanFrame, now_us: float) -> None:
        """Account for a frame of the host that has arrived."""
        self._advance_arbitration(now_us)
        duration_us = self.frame_duration_us_by_length[len(frame.data)]
        self._bus_free_us = min(max(self._bus_free_us, now_us) + duration_us, now_us + MAX_AHEAD_US)
        self.count_frame(frame)

    def enqueue(self, sender: int, frame: CanFrame, now_us: float) -> None:
        """Add a frame that a module wants to send; it replaces one with the same id that still waits."""
        self._advance_arbitration(now_us)
        mailboxes = self._waiting_frame_by_mailbox_by_sender.setdefault(sender, {})
        mailbox = self._choose_mailbox(frame)
        if mailbox in mailboxes:
            _, since_us = mailboxes[mailbox]
            mailboxes[mailbox] = (frame, since_us)
            self._replaced_count += 1
            return
        mailboxes[mailbox] = (frame, now_us)
        if len(mailboxes) == 1:
            heappush(self._arbitration_heap, (frame.id, sender, mailbox))

    def _choose_mailbox(self, frame: CanFrame) -> int:
        """Return the mailbox of a frame: one for each id, but another one for each frame that must not be replaced."""
        if frame.id >> NODE_BITS not in UNREPLACEABLE_OPCODES:
            return frame.id
        self._response_count += 1
        number = self._response_count % MAX_WAITING_RESPONSES + 1
        return frame.id | number << ID_BITS

    def pop_sent_frames(self, now_us: float) -> list[CanFrame]:
        """Return the frames that are completely sent by now, in order, each once."""
        self._advance_arbitration(now_us)
        sent = self._sent_frames
        self._sent_frames = []
        return sent

    def next_us(self) -> float:
        """Return when the next frame will be completely sent; inf if none waits."""
        if self._transmission is not None:
            _, end_us = self._transmission
            return end_us
        if not self._arbitration_heap:
            return inf
        _, sender, mailbox = self._arbitration_heap[0]
        frame, since_us = self._waiting_frame_by_mailbox_by_sender[sender][mailbox]
        return max(self._bus_free_us, since_us) + self.frame_duration_us_by_length[len(frame.data)]

    def count_frame(self, frame: CanFrame) -> None:
        """Add a frame and its time to the traffic."""
        opcode = frame.id >> NODE_BITS
        self._frame_count_by_opcode[opcode] += 1
        self._busy_us_by_opcode[opcode] += self.frame_duration_us_by_length[len(frame.data)]

    def set_babbling(self, sender: int, frame: CanFrame | None, now_us: float) -> None:
        """Let a module repeat a frame as often as the bus allows, from now on; None ends that."""
        self._advance_arbitration(now_us)
        if frame is None:
            self._babble_frame_by_sender.pop(sender, None)
        else:
            self._babble_frame_by_sender[sender] = frame
            self.enqueue(sender, frame, now_us)

    def traffic(self, now_us: float) -> BusTraffic:
        """Return the traffic of the bus until now."""
        return BusTraffic(
            now_us,
            tuple(self._frame_count_by_opcode),
            tuple(self._busy_us_by_opcode),
            self._replaced_count,
            self._max_wait_us,
        )

    def _advance_arbitration(self, now_us: float) -> None:
        """Send waiting frames in the order of arbitration, up to the current time.

        A frame that would start exactly now does not start yet, because others may still be enqueued now.

        Args:
            now_us: Current time.
        """
        while True:
            if self._transmission is not None:
                frame, end_us = self._transmission
                if end_us > now_us:
                    return
                self._sent_frames.append(frame)
                self._transmission = None
            if not self._arbitration_heap:
                return
            _, sender, mailbox = self._arbitration_heap[0]
            _, waiting_since_us = self._waiting_frame_by_mailbox_by_sender[sender][mailbox]
            start_us = max(self._bus_free_us, waiting_since_us)
            if start_us >= now_us:
                return
            heappop(self._arbitration_heap)
            self._start_transmission(sender, mailbox, start_us)

    def _start_transmission(self, sender: int, mailbox: int, start_us: float) -> None:
        """Put the frame in a mailbox on the bus, and let the sender's next frame take part in arbitration."""
        mailboxes = self._waiting_frame_by_mailbox_by_sender[sender]
        frame, since_us = mailboxes.pop(mailbox)
        end_us = start_us + self.frame_duration_us_by_length[len(frame.data)]
        repeated = self._babble_frame_by_sender.get(sender)
        if repeated is not None and repeated.id == mailbox:
            mailboxes[mailbox] = (repeated, end_us)
        if mailboxes:
            next_mailbox, (next_frame, _) = next(iter(mailboxes.items()))
            heappush(self._arbitration_heap, (next_frame.id, sender, next_mailbox))
        self._bus_free_us = end_us
        self._transmission = (frame, end_us)
        self._max_wait_us = max(self._max_wait_us, start_us - since_us)
        self.count_frame(frame)


def traffic_by_opcode(before: BusTraffic, after: BusTraffic) -> list[tuple[Opcode, int, float]]:
    """Return message, number of frames and fraction of time of every message that was sent between two points."""
    duration_us = max(after.now_us - before.now_us, 1.0)
    rows: list[tuple[Opcode, int, float]] = []
    for opcode in Opcode:
        frames = after.frames[opcode] - before.frames[opcode]
        if frames:
            busy_us = after.busy_us[opcode] - before.busy_us[opcode]
            rows.append((opcode, frames, busy_us / duration_us))
    return rows

"""Emulates the timing of a bus for frames on a bus without a bit rate.

Every frame takes as long as with the maximum of stuff bits. A module's frames wait in its order;
whenever the bus is free the lowest id among the first of all modules wins it. The host's frames are seen only after
they have arrived: they take their time on the bus, but cannot be delayed. A newer frame of a module replaces an
unsent one with the same id, as in a transmit mailbox of firmware, so that no queue grows for ever.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from math import inf

from snakesim_can_backend.bus.load import BIT_RATE, worst_frame_bits
from snakesim_can_backend.protocol.definitions import NODE_BITS, Frame, Opcode

OPCODES = 32
MAX_AHEAD_US = 20_000.0  # of frames that the host sends faster than any bus could carry
IN_ORDER = frozenset((Opcode.PARAMETER_ANSWER,))  # each answers another question: none replaces another
MAX_ANSWERS = 64


@dataclass(frozen=True)
class Traffic:
    """Traffic of a bus up to a point in time, by opcode."""

    now_us: float
    frames: tuple[int, ...]
    busy_us: tuple[float, ...]
    replaced: int  # frames that were replaced by newer ones before the bus was free
    late_us: float  # the longest that a frame waited for the bus

    def load_since(self, before: "Traffic") -> float:
        """Load of the bus, as a share of time."""
        took = self.now_us - before.now_us
        return (sum(self.busy_us) - sum(before.busy_us)) / took if took > 0 else 0.0


class BusTime:
    """One bus. Times are microseconds, and must not go backward."""

    def __init__(self, bit_rate: int = BIT_RATE) -> None:
        self.frame_us = [worst_frame_bits(length) * 1e6 / bit_rate for length in range(9)]
        self._free_us = 0.0
        self._waiting: dict[int, dict[int, tuple[Frame, float]]] = {}  # sender -> slot -> frame, since when
        self._first: list[tuple[int, int, int]] = []  # heap: id, sender, slot of the first frame of every sender
        self._under_way: tuple[Frame, float] | None = None
        self._through: list[Frame] = []
        self._answers = 0
        self._endless: dict[int, Frame] = {}
        self._frames, self._busy_us = [0] * OPCODES, [0.0] * OPCODES
        self._replaced, self._late_us = 0, 0.0

    def record_host_frame(self, frame: Frame, now_us: float) -> None:
        """A frame of the host has arrived."""
        self._proceed(now_us)
        took = self.frame_us[len(frame.data)]
        self._free_us = min(max(self._free_us, now_us) + took, now_us + MAX_AHEAD_US)
        self.count_frame(frame)

    def enqueue(self, sender: int, frame: Frame, now_us: float) -> None:
        """A module has a frame to send."""
        self._proceed(now_us)
        queue = self._waiting.setdefault(sender, {})
        slot = frame.id
        if frame.id >> NODE_BITS in IN_ORDER:
            self._answers += 1
            slot |= (self._answers % MAX_ANSWERS + 1) << 11
        if slot in queue:
            queue[slot] = (frame, queue[slot][1])
            self._replaced += 1
            return
        queue[slot] = (frame, now_us)
        if len(queue) == 1:
            heappush(self._first, (frame.id, sender, slot))

    def take_sent_frames(self, now_us: float) -> list[Frame]:
        """Frames that are completely sent by now, in order, each once."""
        self._proceed(now_us)
        through, self._through = self._through, []
        return through

    def next_us(self) -> float:
        """When the next frame will be completely sent; inf when none waits."""
        if self._under_way is not None:
            return self._under_way[1]
        if not self._first:
            return inf
        frame, since = self._waiting[self._first[0][1]][self._first[0][2]]
        return max(self._free_us, since) + self.frame_us[len(frame.data)]

    def count_frame(self, frame: Frame) -> None:
        """Add the bus time of a frame."""
        opcode = frame.id >> NODE_BITS
        self._frames[opcode] += 1
        self._busy_us[opcode] += self.frame_us[len(frame.data)]

    def set_babbling(self, sender: int, frame: Frame | None, now_us: float) -> None:
        """From now on a module repeats a frame, as often as the bus allows; None ends that."""
        self._proceed(now_us)
        if frame is None:
            self._endless.pop(sender, None)
        else:
            self._endless[sender] = frame
            self.enqueue(sender, frame, now_us)

    def traffic(self, now_us: float) -> Traffic:
        """Traffic of the bus until now."""
        return Traffic(now_us, tuple(self._frames), tuple(self._busy_us), self._replaced, self._late_us)

    def _proceed(self, now_us: float) -> None:
        """Run the bus until now; a frame that would begin now waits for others that are offered now."""
        while True:
            if self._under_way is not None:
                frame, end_us = self._under_way
                if end_us > now_us:
                    return
                self._through.append(frame)
                self._under_way = None
            if not self._first:
                return
            _, sender, slot = self._first[0]
            frame, since_us = self._waiting[sender][slot]
            start_us = max(self._free_us, since_us)
            if start_us >= now_us:
                return
            heappop(self._first)
            self._begin(sender, slot, frame, since_us, start_us)

    def _begin(self, sender: int, slot: int, frame: Frame, since_us: float, start_us: float) -> None:
        queue = self._waiting[sender]
        del queue[slot]
        took = self.frame_us[len(frame.data)]
        if sender in self._endless and slot == self._endless[sender].id:
            queue[slot] = (self._endless[sender], start_us + took)
        if queue:
            following, (next_frame, _) = next(iter(queue.items()))
            heappush(self._first, (next_frame.id, sender, following))
        self._free_us = start_us + took
        self._under_way = (frame, self._free_us)
        self._late_us = max(self._late_us, start_us - since_us)
        self.count_frame(frame)


def traffic_by_opcode(before: Traffic, after: Traffic) -> list[tuple[Opcode, int, float]]:
    """Traffic between two points in time: message, frames, share of time; only messages that occurred."""
    took_us = max(after.now_us - before.now_us, 1.0)
    return [
        (opcode, frames, (after.busy_us[opcode] - before.busy_us[opcode]) / took_us)
        for opcode in Opcode
        if (frames := after.frames[opcode] - before.frames[opcode])
    ]

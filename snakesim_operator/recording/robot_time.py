"""Dates a message in robot time: by the tick that it names, if that is plausible, else by the newest clock."""

import msgspec

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE

# A tick further away from the clock is wrong, or belongs to another host.
MAX_CLOCK_DISTANCE_NS = 1_000_000_000
MAX_STORED_TIME_NS = 2**63 - 1  # the file stores unsigned 64 bits; readers use signed ones


class _DatedFields(msgspec.Struct):
    """The fields that date a message; the rest of it is skipped."""

    tick: int | None = None
    timestamp_ns: int | None = None


class _ClockFields(msgspec.Struct):
    """The fields of a clock message that are needed here; the rest of it is skipped."""

    tick: int
    period_ns: int
    clock_mode: str


class MessageClock:
    """Dates messages in robot time, in the order of their arrival."""

    def __init__(self) -> None:
        self._dated_decoder = msgspec.msgpack.Decoder(_DatedFields)
        self._clock_decoder = msgspec.msgpack.Decoder(_ClockFields)
        self.newest_clock: _ClockFields | None = None  # the newest one
        self.has_gone_back = False  # the newest clock is earlier than the previous one
        self._newest_clock_ns = 0  # robot time by the newest clock; 0 before the first one

    def find_robot_time_ns(self, key: str, payload: bytes) -> int:
        """Return the robot time in ns under which a message is recorded.

        This is the time of the tick in the message. If the message has no tick, or a tick more than
        MAX_CLOCK_DISTANCE_NS from the newest clock, it is the time of the newest clock. Before the first clock, it is
        the timestamp in the message. A clock message itself becomes the newest clock.

        Args:
            key: Key at which the message was published.
            payload: The encoded message. If it cannot be decoded, the time of the newest clock is returned.
        """
        try:
            if key == keys.CLOCK:
                return self._update_newest_clock(self._clock_decoder.decode(payload))
            fields = self._dated_decoder.decode(payload)
        except UNDECODABLE:
            return self._newest_clock_ns
        if self.newest_clock is None:
            return _clamp_time_ns(fields.timestamp_ns or 0)
        if fields.tick is not None:
            tick_ns = fields.tick * self.newest_clock.period_ns
            is_near_clock = abs(tick_ns - self._newest_clock_ns) <= MAX_CLOCK_DISTANCE_NS
            if tick_ns >= 0 and is_near_clock:
                return tick_ns
        return self._newest_clock_ns

    def _update_newest_clock(self, clock: _ClockFields) -> int:
        """Store a clock message as the newest one, and return its robot time in ns."""
        self.has_gone_back = self.newest_clock is not None and clock.tick < self.newest_clock.tick
        self.newest_clock = clock
        self._newest_clock_ns = _clamp_time_ns(clock.tick * clock.period_ns)
        return self._newest_clock_ns


def _clamp_time_ns(time_ns: int) -> int:
    return min(max(time_ns, 0), MAX_STORED_TIME_NS)

"""Dates a message in robot time: by the tick that it names, if that is plausible, else by the newest clock."""

import msgspec

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE

MAX_AWAY_NS = 1_000_000_000  # a tick further away from the clock is wrong, or belongs to another host
LATEST_NS = 2**63 - 1  # the file stores unsigned 64 bits; readers use signed ones


class _DatedFields(msgspec.Struct):
    """The fields that date a message; the rest of it is skipped."""

    tick: int | None = None
    timestamp_ns: int | None = None


class _ClockFields(msgspec.Struct):
    """The fields of a clock that are needed here."""

    tick: int
    period_ns: int
    clock_mode: str


class MessageClock:
    """Dates messages in robot time, in the order of their arrival."""

    def __init__(self) -> None:
        self._dated_decoder = msgspec.msgpack.Decoder(_DatedFields)
        self._clock_decoder = msgspec.msgpack.Decoder(_ClockFields)
        self.clock: _ClockFields | None = None  # the newest one
        self.went_back = False  # the newest clock is earlier than the previous one
        self._now_ns = 0  # by the newest clock

    def date(self, key: str, payload: bytes) -> int:
        """Return the robot time at which a recorded message is filed, in ns.

        This is the time of the tick that the message names. If the message names no tick, or one more than MAX_AWAY_NS
        from the newest clock, it is the time of the newest clock. Before the first clock, it is the timestamp in the
        message. A clock message itself sets the newest clock.

        Args:
            key: Key at which the message was published.
            payload: The encoded message.
        """
        try:
            if key == keys.CLOCK:
                return self._set_clock(self._clock_decoder.decode(payload))
            dated = self._dated_decoder.decode(payload)
        except UNDECODABLE:
            return self._now_ns
        if self.clock is None:
            return _limit(dated.timestamp_ns or 0)
        if dated.tick is not None:
            tick_ns = dated.tick * self.clock.period_ns
            is_near_clock = abs(tick_ns - self._now_ns) <= MAX_AWAY_NS
            if tick_ns >= 0 and is_near_clock:
                return tick_ns
        return self._now_ns

    def _set_clock(self, clock: _ClockFields) -> int:
        """Take in the newest clock, and return its robot time in ns."""
        self.went_back = self.clock is not None and clock.tick < self.clock.tick
        self.clock = clock
        self._now_ns = _limit(clock.tick * clock.period_ns)
        return self._now_ns


def _limit(time_ns: int) -> int:
    return min(max(time_ns, 0), LATEST_NS)

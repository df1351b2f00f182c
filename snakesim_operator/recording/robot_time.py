"""The robot time of a message, by the tick that it names, if that is plausible."""

import msgspec

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE

MAX_AWAY_NS = 1_000_000_000  # a tick further away from the clock is a lie, or of another host
LATEST_NS = 2**63 - 1


class _Stamped(msgspec.Struct):
    """What the messages have in common; the rest is skipped."""

    tick: int | None = None
    timestamp_ns: int | None = None


class _Clock(msgspec.Struct):
    tick: int
    period_ns: int
    clock_mode: str


class RobotTime:
    """The time of messages, in the order of their arrival."""

    def __init__(self) -> None:
        self._dated = msgspec.msgpack.Decoder(_Stamped)
        self._clock = msgspec.msgpack.Decoder(_Clock)
        self.clock: _Clock | None = None  # the newest one
        self.went_back = False  # the newest clock is before the one before
        self._now_ns = 0  # by the newest clock

    def of(self, key: str, payload: bytes) -> int:
        """Robot time in ns: of the message's own tick, or of the newest clock when it names none or none near it."""
        try:
            if key == keys.CLOCK:
                clock = self._clock.decode(payload)
                self.went_back = self.clock is not None and clock.tick < self.clock.tick
                self.clock = clock
                self._now_ns = min(max(clock.tick * clock.period_ns, 0), LATEST_NS)
                return self._now_ns
            dated = self._dated.decode(payload)
        except UNDECODABLE:
            return self._now_ns
        if self.clock is None:
            return min(max(dated.timestamp_ns or 0, 0), LATEST_NS)
        if dated.tick is not None:
            at_ns = dated.tick * self.clock.period_ns
            if at_ns >= 0 and abs(at_ns - self._now_ns) <= MAX_AWAY_NS:
                return at_ns
        return self._now_ns

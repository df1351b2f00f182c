"""When each tick of a host ends, and when the state of each recent tick went out. On the monotonic clock."""

import time
from collections import deque

REANCHOR_PERIODS = 1  # later than that, time is moved: ticks that catch up in a burst would break limits of rate
KEPT = 4096
LONG_AGO_NS = -(2**60)


class Deadlines:
    """Absolute ones: a late tick does not push the next ones back, until it is hopeless."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._anchor_ns = 0  # when tick 0 began

    def begin(self, tick: int) -> None:
        """A tick begins now."""
        self._anchor_ns = time.monotonic_ns() - tick * self._period_ns

    def of(self, tick: int) -> int:
        """When a tick begins, which is when the one before it ends."""
        return self._anchor_ns + tick * self._period_ns

    def missed(self, tick: int) -> bool:
        """Whether a tick begins too late; much too late, and all that follow are put off."""
        late_ns = time.monotonic_ns() - self.of(tick)
        if late_ns > REANCHOR_PERIODS * self._period_ns:
            self._anchor_ns += late_ns
        return late_ns > 0


class PublishTimes:
    """Safety time and monotonic time of publishing, by tick; ticks come in order without gaps."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, int, int]] = deque(maxlen=KEPT)  # tick, safety ns, monotonic ns

    @property
    def last_tick(self) -> int | None:
        """The tick that was published last."""
        return self._rows[-1][0] if self._rows else None

    def put(self, tick: int, safety_ns: int, monotonic_ns: int) -> None:
        """A tick was published, perhaps once more."""
        if self.last_tick == tick:
            self._rows.pop()
        self._rows.append((tick, safety_ns, monotonic_ns))

    def of(self, tick: int) -> tuple[int, int]:
        """Safety and monotonic time of a tick; long ago when it is not kept any more, or never was published."""
        back = -1 if self.last_tick is None else self.last_tick - tick
        if 0 <= back < len(self._rows):
            found = self._rows[-1 - back]
            if found[0] == tick:
                return found[1], found[2]
        return LONG_AGO_NS, LONG_AGO_NS

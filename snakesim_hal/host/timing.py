"""Deadline of each tick of a host, and publish time of each recent tick. On the monotonic clock."""

import time
from collections import deque

REANCHOR_PERIODS = 1  # if later, all deadlines are shifted: ticks that catch up in a burst would break rate limits
KEPT = 4096
LONG_AGO_NS = -(2**60)


class Deadlines:
    """Absolute deadlines: a late tick does not delay the next ones, unless it is much too late."""

    def __init__(self, period_ns: int) -> None:
        self._robot_period_ns = self._period_ns = period_ns
        self._anchor_ns = 0  # when tick 0 began

    def begin(self, tick: int, speed: float | None = None) -> None:
        """Start at this tick, now. speed: of robot time from now on; None: as it was."""
        if speed is not None:
            self._period_ns = round(self._robot_period_ns / speed)
        self._anchor_ns = time.monotonic_ns() - tick * self._period_ns

    def of(self, tick: int) -> int:
        """Start time of a tick, which is the end of the previous one."""
        return self._anchor_ns + tick * self._period_ns

    def missed(self, tick: int) -> bool:
        """Whether a tick begins too late; if much too late, all later deadlines are shifted."""
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
        """The newest published tick."""
        return self._rows[-1][0] if self._rows else None

    def put(self, tick: int, safety_ns: int, monotonic_ns: int) -> None:
        """Record the publishing of a tick; it may be a repeated one."""
        if self.last_tick == tick:
            self._rows.pop()
        self._rows.append((tick, safety_ns, monotonic_ns))

    def of(self, tick: int) -> tuple[int, int]:
        """Safety and monotonic time of a tick; a time long ago if it is unknown."""
        back = -1 if self.last_tick is None else self.last_tick - tick
        if 0 <= back < len(self._rows):
            found = self._rows[-1 - back]
            if found[0] == tick:
                return found[1], found[2]
        return LONG_AGO_NS, LONG_AGO_NS

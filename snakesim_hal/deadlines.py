"""When each tick of a robot in real time ends, on the monotonic clock."""

import time

REANCHOR_PERIODS = 1  # later than that, time is moved: ticks that catch up in a burst would break limits of rate


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

"""Deadline of each tick of a host, what its backend takes of it, and publish times. On the monotonic clock."""

import time
from collections import deque

REANCHOR_PERIODS = 1  # if later, all deadlines are shifted: ticks that catch up in a burst would break rate limits
KEPT = 4096
LONG_AGO_NS = -(2**60)
SMOOTHING = 0.1
SETTLED_TICKS = 30
MOST_SHARE = 0.8  # of a period; the rest is for answers


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


class BackendTime:
    """How long the backend's calls take in a tick, smoothed over some ten of them."""

    def __init__(self, backend: str, period_ns: int) -> None:
        self._backend, self._period_ns = backend, period_ns
        self.read_ns = self.write_ns = 0.0
        self._ticks = 0

    def read(self, since_ns: int) -> int:
        """It has been sampled, since then. Returns how long that took, in ns."""
        took_ns = time.monotonic_ns() - since_ns
        self.read_ns += SMOOTHING * (took_ns - self.read_ns)
        self._ticks += 1
        return took_ns

    def written(self, since_ns: int) -> int:
        """It has taken the setpoints, and done what it does between two ticks, since then. Returns as `read` does."""
        took_ns = time.monotonic_ns() - since_ns
        self.write_ns += SMOOTHING * (took_ns - self.write_ns)
        return took_ns

    def too_slow(self) -> list[str]:
        """That its calls leave a tick no time for anything else, and the rate that would hold; empty: they do."""
        taken_ns = self.read_ns + self.write_ns
        if self._ticks < SETTLED_TICKS or taken_ns < MOST_SHARE * self._period_ns:
            return []
        holds_hz = MOST_SHARE * 1e9 / taken_ns
        read_ms, write_ms, period_ms = (ns / 1e6 for ns in (self.read_ns, self.write_ns, self._period_ns))
        return [
            f"backend {self._backend!r} takes {read_ms:.3g} ms to read and {write_ms:.3g} ms to write, of a tick of"
            f" {period_ms:.3g} ms; it would hold {holds_hz:.2g} Hz (the scenario's rate_hz)"
        ]


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

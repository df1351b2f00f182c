"""Keeps time on the monotonic clock: the deadline of each tick, the duration of backend calls, and publish times.

The host's thread makes every call.
"""

import time
from collections import deque

# If later, all deadlines are shifted: ticks that catch up in a burst would break rate limits.
REANCHOR_PERIODS = 1
MAX_STORED_TICKS = 4096  # whose publish times are known
LONG_AGO_NS = -(2**60)  # publish time of a tick that is not known
SMOOTHING = 0.1  # weight of the newest duration
SETTLED_TICKS = 30  # after which a smoothed duration is meaningful
MAX_PERIOD_RATIO = 0.8  # of a period, for the backend; the rest is for answers


class TickDeadlines:
    """Absolute deadlines: a late tick does not delay the next ones, unless it is much too late."""

    def __init__(self, period_ns: int) -> None:
        """Start at speed 1; period_ns: of a tick in robot time."""
        self._robot_period_ns = period_ns
        self._period_ns = period_ns  # in wall time
        self._anchor_ns = 0  # when tick 0 began

    def begin(self, tick: int, speed: float | None = None) -> None:
        """Begin a tick now, and derive all later deadlines from this one.

        Args:
            tick: The tick that begins.
            speed: Robot time per wall time from now on; None: unchanged.
        """
        if speed is not None:
            self._period_ns = round(self._robot_period_ns / speed)
        self._anchor_ns = time.monotonic_ns() - tick * self._period_ns

    def start_ns(self, tick: int) -> int:
        """Return the start time of a tick in ns, which is the end of the previous one."""
        return self._anchor_ns + tick * self._period_ns

    def missed(self, tick: int) -> bool:
        """Return whether a tick begins too late. If it is much too late, all later deadlines are shifted."""
        late_ns = time.monotonic_ns() - self.start_ns(tick)
        if late_ns > REANCHOR_PERIODS * self._period_ns:
            self._anchor_ns += late_ns
        return late_ns > 0


class BackendTimer:
    """Measures how long the backend's calls take in a tick, smoothed over some ten ticks."""

    def __init__(self, backend: str, period_ns: int) -> None:
        """Measure the backend of this name, in ticks of this period."""
        self._backend = backend
        self._period_ns = period_ns
        self.read_ns = 0.0
        self.write_ns = 0.0
        self._ticks = 0

    def record_read(self, since_ns: int) -> int:
        """Record how long the backend has taken to read its sensors.

        Args:
            since_ns: Monotonic time at which the call started.

        Returns:
            The duration in ns.
        """
        duration_ns = time.monotonic_ns() - since_ns
        self.read_ns += SMOOTHING * (duration_ns - self.read_ns)
        self._ticks += 1
        return duration_ns

    def record_write(self, since_ns: int) -> int:
        """Record how long the backend has taken to process setpoints and to advance.

        Args:
            since_ns: Monotonic time at which the first of these calls started.

        Returns:
            The duration in ns.
        """
        duration_ns = time.monotonic_ns() - since_ns
        self.write_ns += SMOOTHING * (duration_ns - self.write_ns)
        return duration_ns

    def describe_slowness(self) -> list[str]:
        """Return one warning, with a feasible rate, if the backend's calls take too long; otherwise an empty list."""
        duration_ns = self.read_ns + self.write_ns
        if self._ticks < SETTLED_TICKS or duration_ns < MAX_PERIOD_RATIO * self._period_ns:
            return []
        feasible_hz = MAX_PERIOD_RATIO * 1e9 / duration_ns
        read_ms = self.read_ns / 1e6
        write_ms = self.write_ns / 1e6
        period_ms = self._period_ns / 1e6
        return [
            f"backend {self._backend!r} takes {read_ms:.3g} ms to read and {write_ms:.3g} ms to write, of a tick of"
            f" {period_ms:.3g} ms; it would hold {feasible_hz:.2g} Hz (the scenario's rate_hz)"
        ]


class PublishTimes:
    """Remembers when each tick was published. Ticks come in order without gaps."""

    def __init__(self) -> None:
        """Start without ticks."""
        # Tick, safety ns, monotonic ns.
        self._published_ticks: deque[tuple[int, int, int]] = deque(maxlen=MAX_STORED_TICKS)

    @property
    def last_tick(self) -> int | None:
        """Return the newest published tick; None if there is none."""
        if not self._published_ticks:
            return None
        return self._published_ticks[-1][0]

    def record(self, tick: int, safety_ns: int, monotonic_ns: int) -> None:
        """Record when a tick was published. If it is the newest one again, its times are replaced."""
        if self.last_tick == tick:
            self._published_ticks.pop()
        self._published_ticks.append((tick, safety_ns, monotonic_ns))

    def find_publish_times_ns(self, tick: int) -> tuple[int, int]:
        """Return the safety time and the monotonic time at which a tick was published, in ns.

        Returns:
            LONG_AGO_NS twice for a tick that was never published, or too long ago to be stored.
        """
        last_tick = self.last_tick
        if last_tick is None:
            return LONG_AGO_NS, LONG_AGO_NS
        ticks_back = last_tick - tick
        if 0 <= ticks_back < len(self._published_ticks):
            published_tick, safety_ns, monotonic_ns = self._published_ticks[-1 - ticks_back]
            if published_tick == tick:
                return safety_ns, monotonic_ns
        return LONG_AGO_NS, LONG_AGO_NS

"""Checks of the stamps of a motion-capture system: order, lateness, and jumps of its clock.

Its clock and ours have different epochs. The smallest difference of the last seconds between reading time and
stamp is taken as the offset of the two clocks; a sample is late by the excess of its own difference. Rejected:

    duplicate   the newest stamp again, or less than 1 ms after it
    reordered   older than the newest stamp
    late        more than 0.25 s later than the fastest samples
    future      more than 50 ms ahead of the fastest samples

A clock that was set or restarted makes every stamp late, reordered or from the future. When five readings in a row
bring only such stamps, and these agree with one another, they are accepted from then on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Refusal = Literal["duplicate", "reordered", "late", "future"]

MIN_APART_NS = 1_000_000
MAX_LATE_NS = 250_000_000
MAX_EARLY_NS = 50_000_000
SAME_CLOCK_NS = 50_000_000  # two offsets no further apart are of one clock
READINGS_TO_BELIEVE = 5
WINDOW_NS = 10_000_000_000  # the offset is the minimum over one to two of these, so that clocks may drift


class CaptureTimes:
    """Checks stamps in their order of arrival. Pure: stamps and the time of reading in, no clock."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._offset = _Offset()
        self._other: _Candidate | None = None
        self.jumps = 0  # of the other clock

    def find_refusals(self, timestamps_ns: Sequence[int], now_ns: int) -> list[Refusal | None]:
        """Why each of the stamps of one reading is rejected; None for the valid ones."""
        if not timestamps_ns:
            return []
        if self._newest_ns is None:
            self._offset.take(now_ns - max(timestamps_ns), now_ns)
        verdicts: list[Refusal | None] = [self._take(timestamp_ns, now_ns) for timestamp_ns in timestamps_ns]
        if None in verdicts:
            self._other = None
            return verdicts
        strange = [at for at, why in enumerate(verdicts) if why != "duplicate"]
        if strange and self._believed(timestamps_ns[strange[-1]], now_ns):
            verdicts[strange[-1]] = None
        return verdicts

    def lateness_ns(self, timestamp_ns: int, now_ns: int) -> int:
        """Delay of a sample relative to the fastest ones."""
        return max(now_ns - timestamp_ns - self._offset.min_ns, 0)

    def _take(self, timestamp_ns: int, now_ns: int) -> Refusal | None:
        newest_ns = self._newest_ns
        if newest_ns is not None and timestamp_ns < newest_ns:
            return "reordered"
        if newest_ns is not None and timestamp_ns < newest_ns + MIN_APART_NS:
            return "duplicate"
        late_ns = now_ns - timestamp_ns - self._offset.min_ns
        if late_ns > MAX_LATE_NS:
            return "late"
        if late_ns < -MAX_EARLY_NS:
            return "future"
        self._newest_ns = timestamp_ns
        self._offset.take(now_ns - timestamp_ns, now_ns)
        return None

    def _believed(self, timestamp_ns: int, now_ns: int) -> bool:
        """A reading brought only rejected stamps; this is its last. True when the other clock has jumped."""
        other, offset_ns = self._other, now_ns - timestamp_ns
        agrees = (
            other is not None
            and abs(offset_ns - other.offset_ns) <= SAME_CLOCK_NS
            and timestamp_ns > other.timestamp_ns
        )
        if other is None or not agrees:
            other = self._other = _Candidate(offset_ns, timestamp_ns)
        other.readings += 1
        other.timestamp_ns = timestamp_ns
        if other.readings < READINGS_TO_BELIEVE:
            return False
        self.jumps += 1
        self._newest_ns, self._other, self._offset = timestamp_ns, None, _Offset()
        self._offset.take(offset_ns, now_ns)
        return True


@dataclass
class _Candidate:
    """The other clock's offset if the rejected stamps were right."""

    offset_ns: int
    timestamp_ns: int
    readings: int = 0


class _Offset:
    """The minimum difference of the two clocks in the last one or two windows."""

    def __init__(self) -> None:
        self._began_ns: int | None = None
        self._before_ns = self._now_ns = 0

    @property
    def min_ns(self) -> int:
        return min(self._before_ns, self._now_ns)

    def take(self, difference_ns: int, now_ns: int) -> None:
        if self._began_ns is None:
            self._began_ns, self._before_ns, self._now_ns = now_ns, difference_ns, difference_ns
        elif now_ns - self._began_ns > WINDOW_NS:
            self._began_ns, self._before_ns, self._now_ns = now_ns, self._now_ns, difference_ns
        self._now_ns = min(self._now_ns, difference_ns)

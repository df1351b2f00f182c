"""Checks the timestamps of a motion-capture system: order, lateness, and jumps of its clock.

Its clock and that of the driver have different epochs. The smallest difference of the last seconds between reading time
and timestamp is taken as the offset of the two clocks. A sample is late by the excess of its own difference:

    offset   = min(reading time - timestamp)
    lateness = reading time - timestamp - offset

Rejected are:

    duplicate   the newest timestamp again, or less than 1 ms after it
    reordered   older than the newest timestamp
    late        more than 0.25 s later than the fastest samples
    future      more than 50 ms ahead of the fastest samples

A clock that was set or restarted makes every timestamp late, reordered or from the future. When five readings in a row
bring only such timestamps, and these agree with one another, they are accepted from then on.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Refusal = Literal["duplicate", "reordered", "late", "future"]

MIN_APART_NS = 1_000_000
MAX_LATE_NS = 250_000_000
MAX_EARLY_NS = 50_000_000
SAME_CLOCK_NS = 50_000_000  # two offsets that differ by no more are of one clock
READINGS_TO_BELIEVE = 5  # readings in a row, before a jump of the clock is accepted
WINDOW_NS = 10_000_000_000  # the offset is the minimum over one to two of these, so that clocks may drift


class CaptureTimes:
    """Checks timestamps in their order of arrival. Pure: the caller passes the time of reading."""

    def __init__(self) -> None:
        """Begin without any timestamp."""
        self._newest_ns: int | None = None  # the newest accepted timestamp
        self._offset = _ClockOffset()
        self._candidate: _Candidate | None = None  # a clock that only rejected timestamps show
        self.jumps = 0  # of the other clock

    def find_refusals(self, timestamps_ns: Sequence[int], now_ns: int) -> list[Refusal | None]:
        """Find duplicate, outdated and implausible timestamps among those of one reading.

        Args:
            timestamps_ns: The timestamps, in their order of arrival.
            now_ns: Time of the reading.

        Returns:
            For each timestamp, why it is rejected; None for the valid ones.
        """
        if not timestamps_ns:
            return []
        if self._newest_ns is None:
            self._offset.add(now_ns - max(timestamps_ns), now_ns)
        refusals: list[Refusal | None] = []
        for timestamp_ns in timestamps_ns:
            refusals.append(self._check_timestamp(timestamp_ns, now_ns))
        if None in refusals:
            self._candidate = None
            return refusals
        contradictory = [i for i, refusal in enumerate(refusals) if refusal != "duplicate"]
        if contradictory:
            last = contradictory[-1]
            if self._has_clock_jumped(timestamps_ns[last], now_ns):
                refusals[last] = None
        return refusals

    def lateness_ns(self, timestamp_ns: int, now_ns: int) -> int:
        """Return the delay of a sample relative to the fastest ones."""
        return max(now_ns - timestamp_ns - self._offset.min_ns, 0)

    def _check_timestamp(self, timestamp_ns: int, now_ns: int) -> Refusal | None:
        """Return why a timestamp is rejected, or accept it and return None."""
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
        self._offset.add(now_ns - timestamp_ns, now_ns)
        return None

    def _has_clock_jumped(self, timestamp_ns: int, now_ns: int) -> bool:
        """Decide after a reading whose timestamps were all rejected whether the other clock has jumped.

        A jump is believed after READINGS_TO_BELIEVE readings that agree with each other. Then the new time is accepted.

        Args:
            timestamp_ns: The last timestamp of the reading.
            now_ns: Time of the reading.
        """
        offset_ns = now_ns - timestamp_ns
        candidate = self._candidate
        if candidate is None or not candidate.agrees_with(offset_ns, timestamp_ns):
            candidate = _Candidate(offset_ns, timestamp_ns)
            self._candidate = candidate
        candidate.readings += 1
        candidate.timestamp_ns = timestamp_ns
        if candidate.readings < READINGS_TO_BELIEVE:
            return False
        self.jumps += 1
        self._newest_ns = timestamp_ns
        self._candidate = None
        self._offset = _ClockOffset()
        self._offset.add(offset_ns, now_ns)
        return True


@dataclass
class _Candidate:
    """The other clock's offset if the rejected timestamps were right."""

    offset_ns: int
    timestamp_ns: int  # the newest one
    readings: int = 0  # in a row that agree

    def agrees_with(self, offset_ns: int, timestamp_ns: int) -> bool:
        """Return whether a timestamp is a later one of the same clock."""
        return abs(offset_ns - self.offset_ns) <= SAME_CLOCK_NS and timestamp_ns > self.timestamp_ns


class _ClockOffset:
    """The minimum difference of the two clocks in the last one or two windows."""

    def __init__(self) -> None:
        self._window_start_ns: int | None = None
        self._previous_min_ns = 0  # of the window before
        self._present_min_ns = 0

    @property
    def min_ns(self) -> int:
        return min(self._previous_min_ns, self._present_min_ns)

    def add(self, difference_ns: int, now_ns: int) -> None:
        if self._window_start_ns is None:
            self._window_start_ns = now_ns
            self._previous_min_ns = difference_ns
            self._present_min_ns = difference_ns
        elif now_ns - self._window_start_ns > WINDOW_NS:
            self._window_start_ns = now_ns
            self._previous_min_ns = self._present_min_ns
            self._present_min_ns = difference_ns
        self._present_min_ns = min(self._present_min_ns, difference_ns)

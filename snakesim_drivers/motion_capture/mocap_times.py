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

Rejection = Literal["duplicate", "reordered", "late", "future"]

MIN_TIMESTAMP_INTERVAL_NS = 1_000_000
MAX_LATENESS_NS = 250_000_000
MAX_EARLINESS_NS = 50_000_000
MAX_OFFSET_DIFFERENCE_NS = 50_000_000  # two offsets that differ by no more are of one clock
MIN_CONSISTENT_READINGS = 5  # readings in a row, before a jump of the clock is accepted
# The offset is the minimum over one to two of these, so that clocks may drift.
WINDOW_NS = 10_000_000_000


class CaptureTimes:
    """Checks timestamps in their order of arrival. Pure: the caller passes the time of reading."""

    def __init__(self) -> None:
        """Create the state of a clock of which no timestamp is known yet."""
        self._newest_timestamp_ns: int | None = None  # the newest accepted timestamp
        self._clock_offset = _ClockOffset()
        # A clock that only rejected timestamps show.
        self._clock_candidate: _ClockCandidate | None = None
        self.jump_count = 0  # of the other clock

    def check_timestamps(self, timestamps_ns: Sequence[int], now_ns: int) -> list[Rejection | None]:
        """Check the timestamps of all samples that were read in one control cycle, and update the clock offset.

        Duplicate, reordered, late and future timestamps are rejected. After several readings with consistent
        timestamps of which none is accepted, a jump of the other clock is assumed, and the last timestamp is accepted.

        Args:
            timestamps_ns: Timestamps of the samples by the other clock, in their order of arrival.
            now_ns: Time of the reading by the driver's clock.

        Returns:
            The reason for the rejection of each timestamp, or None if it is accepted.
        """
        if not timestamps_ns:
            return []
        if self._newest_timestamp_ns is None:
            self._clock_offset.add(now_ns - max(timestamps_ns), now_ns)
        rejections: list[Rejection | None] = []
        for timestamp_ns in timestamps_ns:
            rejections.append(self._accept_or_reject_timestamp(timestamp_ns, now_ns))
        if None in rejections:
            self._clock_candidate = None
            return rejections
        rejected_indices = [i for i, rejection in enumerate(rejections) if rejection != "duplicate"]
        if rejected_indices:
            last = rejected_indices[-1]
            if self._detect_clock_jump(timestamps_ns[last], now_ns):
                rejections[last] = None
        return rejections

    def compute_lateness_ns(self, timestamp_ns: int, now_ns: int) -> int:
        """Return the delay of a sample in ns, relative to the samples that arrive fastest."""
        return max(now_ns - timestamp_ns - self._clock_offset.min_ns, 0)

    def _accept_or_reject_timestamp(self, timestamp_ns: int, now_ns: int) -> Rejection | None:
        """Return why a timestamp is rejected; otherwise store it as the newest one and return None."""
        newest_timestamp_ns = self._newest_timestamp_ns
        if newest_timestamp_ns is not None and timestamp_ns < newest_timestamp_ns:
            return "reordered"
        if (
            newest_timestamp_ns is not None
            and timestamp_ns < newest_timestamp_ns + MIN_TIMESTAMP_INTERVAL_NS
        ):
            return "duplicate"
        lateness_ns = now_ns - timestamp_ns - self._clock_offset.min_ns
        if lateness_ns > MAX_LATENESS_NS:
            return "late"
        if lateness_ns < -MAX_EARLINESS_NS:
            return "future"
        self._newest_timestamp_ns = timestamp_ns
        self._clock_offset.add(now_ns - timestamp_ns, now_ns)
        return None

    def _detect_clock_jump(self, timestamp_ns: int, now_ns: int) -> bool:
        """Detect a jump of the other clock after a reading whose timestamps were all rejected.

        A jump is detected after MIN_CONSISTENT_READINGS such readings in a row whose timestamps are consistent with one
        another. Then the new clock offset replaces the old one.

        Args:
            timestamp_ns: Last timestamp of the reading that contradicts the known clock offset.
            now_ns: Time of the reading by the driver's clock.

        Returns:
            Whether a jump was detected, so that this timestamp is accepted.
        """
        offset_ns = now_ns - timestamp_ns
        candidate = self._clock_candidate
        if candidate is None or not candidate.agrees_with(offset_ns, timestamp_ns):
            candidate = _ClockCandidate(offset_ns, timestamp_ns)
            self._clock_candidate = candidate
        candidate.readings += 1
        candidate.timestamp_ns = timestamp_ns
        if candidate.readings < MIN_CONSISTENT_READINGS:
            return False
        self.jump_count += 1
        self._newest_timestamp_ns = timestamp_ns
        self._clock_candidate = None
        self._clock_offset = _ClockOffset()
        self._clock_offset.add(offset_ns, now_ns)
        return True


@dataclass
class _ClockCandidate:
    """The other clock's offset if the rejected timestamps were right."""

    offset_ns: int
    timestamp_ns: int  # the newest one
    readings: int = 0  # in a row that agree

    def agrees_with(self, offset_ns: int, timestamp_ns: int) -> bool:
        """Return whether a timestamp is a later one of the same clock."""
        return (
            abs(offset_ns - self.offset_ns) <= MAX_OFFSET_DIFFERENCE_NS
            and timestamp_ns > self.timestamp_ns
        )


class _ClockOffset:
    """The minimum difference of the two clocks in the last one or two windows."""

    def __init__(self) -> None:
        self._window_start_ns: int | None = None
        self._previous_min_ns = 0  # of the window before
        self._current_min_ns = 0

    @property
    def min_ns(self) -> int:
        return min(self._previous_min_ns, self._current_min_ns)

    def add(self, difference_ns: int, now_ns: int) -> None:
        if self._window_start_ns is None:
            self._window_start_ns = now_ns
            self._previous_min_ns = difference_ns
            self._current_min_ns = difference_ns
        elif now_ns - self._window_start_ns > WINDOW_NS:
            self._window_start_ns = now_ns
            self._previous_min_ns = self._current_min_ns
            self._current_min_ns = difference_ns
        self._current_min_ns = min(self._current_min_ns, difference_ns)

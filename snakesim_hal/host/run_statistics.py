"""Collects the run statistics of the HAL host: histograms of durations, and counts of ticks."""

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from itertools import accumulate

from snakesim_hal.wire.messages import TimingStatistics

MAX_PUBLISHED_BINS = 16  # at most, in a published histogram
MAX_DURATION_US = 1e7
FINE_BIN_RATIO = 0.01  # width of a bin, relative to the duration
COARSE_BIN_RATIO = 0.05


class DurationHistogram:
    """A histogram of durations from 1 us to 10 s. Its memory has a fixed size, however long the run.

    Bin i holds durations near exp(i * step) us, so that each bin is wider than the one before by the same ratio.
    The host's thread adds durations; other threads may read percentiles meanwhile.
    """

    def __init__(self, bin_width_ratio: float = FINE_BIN_RATIO) -> None:
        """Start without durations.

        Args:
            bin_width_ratio: Width of a bin, divided by the duration.
        """
        self.count = 0
        self._step = math.log1p(bin_width_ratio)
        self._last_index = math.ceil(math.log(MAX_DURATION_US) / self._step)
        self._bins = [0] * (self._last_index + 1)

    def add(self, duration_us: float) -> None:
        """Add a duration to the histogram."""
        # From 0 on, because the logarithm is not negative.
        index = round(math.log(max(duration_us, 1.0)) / self._step)
        self._bins[min(index, self._last_index)] += 1
        self.count += 1

    def percentile_us(self, percent: float) -> float | None:
        """Return a percentile of the durations; None if there are none."""
        if not self.count:
            return None
        return self._find_percentile_us(list(accumulate(self._bins)), percent)

    def timing(self) -> TimingStatistics | None:
        """Return percentiles and a coarse histogram of the durations, from their logarithmic bins.

        Returns:
            The statistics in microseconds, or None if there are no durations. The histogram has at most
            MAX_PUBLISHED_BINS bins, from the first to the last bin that is not empty.
        """
        bins = self._bins.copy()  # the host's thread may add durations at the same time
        cumulative = list(accumulate(bins))
        count = cumulative[-1]
        if not count:
            return None
        first_bin = bisect_left(cumulative, 1)  # the first bin that is not empty
        end_bin = bisect_left(cumulative, count) + 1  # the bin after the last one that is not empty
        # Number of bins that are merged into a published one.
        merged_count = math.ceil((end_bin - first_bin) / MAX_PUBLISHED_BINS)
        merged_bins = [
            sum(bins[i : i + merged_count]) for i in range(first_bin, end_bin, merged_count)
        ]
        return TimingStatistics(
            count=count,
            median_us=self._find_percentile_us(cumulative, 50),
            p99_us=self._find_percentile_us(cumulative, 99),
            max_us=math.exp((end_bin - 1) * self._step),
            low_us=math.exp(
                (first_bin - 0.5) * self._step
            ),  # lower end of the first bin, whose middle is at its index
            bin_decades=merged_count * self._step / math.log(10),
            bins=merged_bins,
        )

    def _find_percentile_us(self, cumulative: list[int], percent: float) -> float:
        """Return the duration of the bin in which the cumulative count reaches a percentage of all."""
        rank = max(percent / 100 * cumulative[-1], 1)
        return math.exp(bisect_left(cumulative, rank) * self._step)


def _make_coarse_histogram() -> DurationHistogram:
    return DurationHistogram(COARSE_BIN_RATIO)


@dataclass
class TickTimes:
    """Durations of the parts of a tick, while the robot is armed."""

    # From the start of a tick to the start of the next.
    cycle: DurationHistogram = field(default_factory=DurationHistogram)
    # Start of a tick after its deadline.
    late: DurationHistogram = field(default_factory=_make_coarse_histogram)
    read: DurationHistogram = field(default_factory=_make_coarse_histogram)  # the backend's sample
    # The backend takes setpoints, and lets the tick pass.
    write: DurationHistogram = field(default_factory=_make_coarse_histogram)

    def timings(self) -> dict[str, TimingStatistics]:
        """Return the timing of each part that was measured, by its name."""
        timings = {
            "cycle": self.cycle.timing(),
            "late": self.late.timing(),
            "read": self.read.timing(),
            "write": self.write.timing(),
        }
        return {name: timing for name, timing in timings.items() if timing is not None}


@dataclass
class RunStatistics:
    """Statistics of the host while the robot is armed."""

    ticks: int = 0
    overruns: int = 0
    answered_ticks: int = 0  # ticks with a command that came in time
    state_to_command: DurationHistogram = field(default_factory=DurationHistogram)
    times: TickTimes = field(default_factory=TickTimes)

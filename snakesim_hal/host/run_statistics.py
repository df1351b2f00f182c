"""The run statistics of the HAL host."""

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from itertools import accumulate

from snakesim_hal.wire.messages import Timing

SHOWN_BINS = 16


class Durations:
    """A histogram of durations, 1 us to 10 s: in memory of fixed size, however long the run."""

    def __init__(self, width: float = 0.01) -> None:
        """width: of a bin, as a share of the duration."""
        self.count = 0
        self._step = math.log1p(width)
        self._bins = [0] * (1 + math.ceil(math.log(1e7) / self._step))

    def add(self, took_us: float) -> None:
        """Add one."""
        self._bins[min(max(round(math.log(max(took_us, 1.0)) / self._step), 0), len(self._bins) - 1)] += 1
        self.count += 1

    def percentile_us(self, percent: float) -> float | None:
        """None when nothing was counted."""
        return self._percentile_us(list(accumulate(self._bins)), percent) if self.count else None

    def timing(self) -> Timing | None:
        """Percentiles and a coarse histogram; None when nothing was counted."""
        bins = self._bins.copy()
        up_to = list(accumulate(bins))
        if not up_to[-1]:
            return None
        first, end = bisect_left(up_to, 1), bisect_left(up_to, up_to[-1]) + 1
        width = -(-(end - first) // SHOWN_BINS)
        return Timing(
            count=up_to[-1],
            median_us=self._percentile_us(up_to, 50),
            p99_us=self._percentile_us(up_to, 99),
            max_us=math.exp((end - 1) * self._step),
            low_us=math.exp((first - 0.5) * self._step),
            bin_decades=width * self._step / math.log(10),
            bins=[sum(bins[begin : begin + width]) for begin in range(first, end, width)],
        )

    def _percentile_us(self, up_to: list[int], percent: float) -> float:
        return math.exp(bisect_left(up_to, max(percent / 100 * up_to[-1], 1)) * self._step)


def _coarse() -> Durations:
    return Durations(0.05)


@dataclass
class TickTimes:
    """How ticks keep time, while armed."""

    cycle: Durations = field(default_factory=Durations)  # from the begin of a tick to that of the next
    late: Durations = field(default_factory=_coarse)  # begin of a tick after its deadline
    read: Durations = field(default_factory=_coarse)  # the backend's sample
    write: Durations = field(default_factory=_coarse)  # the backend takes setpoints, and lets the tick pass

    def timings(self) -> dict[str, Timing]:
        """Of each that was counted."""
        found = {name: getattr(self, name).timing() for name in ("cycle", "late", "read", "write")}
        return {name: timing for name, timing in found.items() if timing is not None}


@dataclass
class RunStatistics:
    """Statistics of the host while armed."""

    ticks: int = 0
    overruns: int = 0
    answered_ticks: int = 0  # ticks with a command that came in time
    state_to_command: Durations = field(default_factory=Durations)
    times: TickTimes = field(default_factory=TickTimes)

"""The run statistics of the HAL host."""

import math
from dataclasses import dataclass, field

STEP = math.log(1.01)  # a bin is 1 % wide
BINS = 1 + math.ceil(math.log(1e7) / STEP)  # 1 us to 10 s


class Latencies:
    """A histogram of durations, to 1 %: in memory of fixed size, however long the run."""

    def __init__(self) -> None:
        self.count = 0
        self._bins = [0] * BINS

    def add(self, took_us: float) -> None:
        """Add one."""
        self._bins[min(max(round(math.log(max(took_us, 1.0)) / STEP), 0), BINS - 1)] += 1
        self.count += 1

    def percentile_us(self, percent: float) -> float | None:
        """None when nothing was counted."""
        left = percent / 100 * self.count
        for place, count in enumerate(self._bins if self.count else ()):
            left -= count
            if left <= 0:
                return math.exp(place * STEP)
        return None


@dataclass
class RunStatistics:
    """Statistics of the host while armed."""

    ticks: int = 0
    overruns: int = 0
    answered_ticks: int = 0  # ticks with a command that came in time
    state_to_command: Latencies = field(default_factory=Latencies)

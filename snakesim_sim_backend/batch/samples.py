"""Rates and delays of the sensors of many robots."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.sensors.timing import SamplingSchedule, round_to_ticks

Mask = NDArray[np.bool_]  # (robots,)
Ticks = NDArray[np.int64]  # (robots,)
FIRST_TICKS = 1024  # for which due times are computed at first


class DueTicks:
    """At which ticks a sensor samples."""

    def __init__(self, sensor_hz: float, tick_hz: float, period_ns: int) -> None:
        self._schedule = SamplingSchedule(sensor_hz, tick_hz, period_ns)
        self._period_ns = period_ns
        self._always = sensor_hz >= tick_hz
        self._due: Mask = np.zeros(0, dtype=np.bool_)  # by tick

    def find_due(self, ticks: Ticks, active: Mask) -> Mask:
        """Return which of the active robots sample at their present ticks."""
        if self._always:
            return active
        if ticks.max() >= len(self._due):
            count = max(2 * len(self._due), FIRST_TICKS, int(ticks.max()) + 1)
            self._due = np.array([self._schedule.is_due(tick * self._period_ns) for tick in range(count)])
        return self._due[ticks] & active


class DelayedValues:
    """The newest values of a sensor that have been delivered, after its delay.

    Attributes:
        values: (robots, n), those that were delivered last.
        is_known: (robots,), whether any have been delivered in this episode.
        is_new: (robots,), whether they were delivered at this tick.
    """

    def __init__(self, robots: int, width: int, delay_s: float, period_ns: int) -> None:
        self._delay_ticks = round_to_ticks(delay_s, period_ns)
        self._waiting: deque[tuple[Floats, Mask]] = deque()  # values, and which of them are samples
        self.values: Floats = np.zeros((robots, width))
        self.is_known: Mask = np.zeros(robots, dtype=np.bool_)
        self.is_new: Mask = np.zeros(robots, dtype=np.bool_)

    def restart(self, robot: int) -> None:
        """Forget all samples of a robot."""
        self.is_known[robot] = False
        self.is_new[robot] = False
        for _, due in self._waiting:
            due[robot] = False

    def add(self, values: Floats, due: Mask, *, starts: bool = False) -> None:
        """Take in the samples of a tick, and deliver those whose delay is over.

        Args:
            values: (robots, n), which must not change afterwards.
            due: which of them are samples.
            starts: whether these are samples of robots that have just been reset, while the others go on.
        """
        if self._delay_ticks:
            if starts and self._waiting:
                waiting_values, waiting_due = self._waiting[-1]  # the others have taken their samples of this tick
                np.copyto(waiting_values, values, where=due[:, None])
                waiting_due |= due
                return
            self._waiting.append((values, due.copy()))
            if len(self._waiting) <= self._delay_ticks:
                self.is_new = np.zeros_like(due)
                return
            values, due = self._waiting.popleft()
        self.is_new = due
        if np.count_nonzero(due):
            self.is_known = self.is_known | due
            np.copyto(self.values, values, where=due[:, None])

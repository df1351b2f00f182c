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
        self._calls = 0  # no robot has made more ticks

    def find_due(self, ticks: Ticks, active: Mask) -> Mask:
        """Return which of the active robots sample at their present ticks."""
        if self._always:
            return active
        self._calls += 1
        if self._calls > len(self._due):
            count = max(2 * len(self._due), FIRST_TICKS)
            self._due = np.array([self._schedule.is_due(tick * self._period_ns) for tick in range(count)])
        return self._due.take(ticks) & active


class DelayedValues:
    """The newest values of a sensor that have been delivered, after its delay.

    Attributes:
        values: (robots, n), those that were delivered last.
        is_known: (robots,), whether any have been delivered in this episode.
        is_new: (robots,), whether they were delivered at this tick; the same object as `no_robots` if none were.
        no_robots: the mask without robots.
    """

    def __init__(self, all_robots: Mask, width: int, delay_s: float, period_ns: int) -> None:
        """Start without samples.

        Args:
            all_robots: the mask of all robots.
            width: number of values.
            delay_s: from the measurement to the delivery.
            period_ns: of the control cycle.
        """
        robots = len(all_robots)
        self._delay_ticks = round_to_ticks(delay_s, period_ns)
        self._all_robots = all_robots
        self.no_robots: Mask = np.zeros(robots, dtype=np.bool_)
        self._waiting: deque[tuple[Floats, Mask]] = deque()  # values, and which of them are samples
        self.values: Floats = np.zeros((robots, width))
        self.is_known: Mask = np.zeros(robots, dtype=np.bool_)
        self.is_new: Mask = np.zeros(robots, dtype=np.bool_)

    def restart(self, robot: int) -> None:
        """Forget all samples of a robot."""
        self.is_known = self.is_known.copy()
        self.is_known[robot] = False
        self.is_new = self.no_robots
        for age, (values, due) in enumerate(self._waiting):
            others_due = due.copy()
            others_due[robot] = False
            self._waiting[age] = (values, others_due)

    def add(self, values: Floats, due: Mask, *, starts: bool = False) -> None:
        """Store the samples of a tick, and deliver those whose delay is over.

        Args:
            values: (robots, n) values, which must not change afterwards.
            due: (robots,) which robots have a sample in this tick.
            starts: whether these are samples of robots that have just been reset, while the others continue.
        """
        if self._delay_ticks:
            if starts and self._waiting:
                waiting, waiting_due = self._waiting[-1]  # the others have taken their samples of this tick
                self._waiting[-1] = (np.where(due[:, None], values, waiting), waiting_due | due)
                return
            self._waiting.append((values, due))
            if len(self._waiting) <= self._delay_ticks:
                self.is_new = self.no_robots
                return
            values, due = self._waiting.popleft()
        self.is_new = due
        if due is self._all_robots:
            self.is_known = due
            self.values = values
        else:
            self.is_known = self.is_known | due
            self.values = np.where(due[:, None], values, self.values)

    def add_nothing(self) -> None:
        """Go on by a tick in which no robot samples."""
        if self._delay_ticks:
            self.add(self.values, self.no_robots)
        else:
            self.is_new = self.no_robots

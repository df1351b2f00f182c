"""Rates and delays of the sensors of many robots."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.sensors.timing import SamplingSchedule, round_to_ticks

Mask = NDArray[np.bool_]  # (robots,)
Ticks = NDArray[np.int64]  # (robots,)
FIRST_TICKS = 1024  # for which due times are computed at first


class SamplingTicks:
    """Ticks at which a sensor samples."""

    def __init__(self, sensor_hz: float, tick_hz: float, period_ns: int) -> None:
        self._schedule = SamplingSchedule(sensor_hz, tick_hz, period_ns)
        self._period_ns = period_ns
        self._samples_always = sensor_hz >= tick_hz
        self._is_due_by_tick: Mask = np.zeros(0, dtype=np.bool_)
        self._call_count = 0  # no robot has made more ticks than this

    def find_due_robots(self, ticks: Ticks, active: Mask) -> Mask:
        """Return a mask of the active robots that sample at their current ticks."""
        if self._samples_always:
            return active
        self._call_count += 1
        if self._call_count > len(self._is_due_by_tick):
            tick_count = max(2 * len(self._is_due_by_tick), FIRST_TICKS)
            is_due = [self._schedule.is_due(tick * self._period_ns) for tick in range(tick_count)]
            self._is_due_by_tick = np.array(is_due)
        return self._is_due_by_tick.take(ticks) & active


class DelayedValues:
    """The newest values of a sensor that have been delivered, after its delay.

    Attributes:
        values: (robots, n), those that were delivered last.
        is_known: (robots,), whether any have been delivered in this episode.
        is_new: (robots,), whether they were delivered at this tick; the same object as `no_robots` if none were.
        no_robots: The mask without robots.
    """

    def __init__(self, all_robots: Mask, width: int, delay_s: float, period_ns: int) -> None:
        """Start without samples.

        Args:
            all_robots: Mask of all robots.
            width: Number of values of each robot.
            delay_s: Time from the measurement to the delivery, in s.
            period_ns: Duration of a control cycle, in ns.
        """
        robots = len(all_robots)
        self._delay_ticks = round_to_ticks(delay_s, period_ns)
        self._all_robots = all_robots
        self.no_robots: Mask = np.zeros(robots, dtype=np.bool_)
        # Values, and the mask of robots with a sample.
        self._delay_queue: deque[tuple[Floats, Mask]] = deque()
        self.values: Floats = np.zeros((robots, width))
        self.is_known: Mask = np.zeros(robots, dtype=np.bool_)
        self.is_new: Mask = np.zeros(robots, dtype=np.bool_)

    def restart(self, robot_index: int) -> None:
        """Remove all samples of a robot."""
        self.is_known = self.is_known.copy()
        self.is_known[robot_index] = False
        self.is_new = self.no_robots
        for queue_index, (values, due) in enumerate(self._delay_queue):
            other_robots_due = due.copy()
            other_robots_due[robot_index] = False
            self._delay_queue[queue_index] = (values, other_robots_due)

    def add(self, values: Floats, due: Mask, *, is_reset: bool = False) -> None:
        """Store the samples of a tick, and deliver those whose delay is over.

        Args:
            values: (robots, n) values, which must not change afterwards.
            due: (robots,) mask of the robots that have a sample in this tick.
            is_reset: Whether these are samples of robots that have just been reset, after the other robots have been
                sampled in this tick.
        """
        if self._delay_ticks:
            if is_reset and self._delay_queue:
                # The other robots' samples of this tick are queued already: merge the new ones into them.
                last_values, last_due = self._delay_queue[-1]
                self._delay_queue[-1] = (
                    np.where(due[:, None], values, last_values),
                    last_due | due,
                )
                return
            self._delay_queue.append((values, due))
            if len(self._delay_queue) <= self._delay_ticks:
                self.is_new = self.no_robots
                return
            values, due = self._delay_queue.popleft()
        self.is_new = due
        if due is self._all_robots:  # the usual case, which is faster without a mask
            self.is_known = due
            self.values = values
        else:
            self.is_known = self.is_known | due
            self.values = np.where(due[:, None], values, self.values)

    def append_empty_tick(self) -> None:
        """Advance by a tick in which no robot samples, so that delayed samples are delivered in time."""
        if self._delay_ticks:
            self.add(self.values, self.no_robots)
        else:
            self.is_new = self.no_robots

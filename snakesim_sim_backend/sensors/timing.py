"""When a sensor is due, and the delay of its samples."""

from collections import deque

import msgspec

from snakesim_hal.wire.messages import Message


class SamplingSchedule:
    """Which ticks a sensor of a given rate samples: those at which floor(stamp * rate) advances, computed exactly."""

    def __init__(self, sensor_hz: float, tick_hz: float, period_ns: int) -> None:
        self._always = sensor_hz >= tick_hz
        top, bottom = sensor_hz.as_integer_ratio()
        self._top, self._bottom = top, bottom * 10**9
        self._period_ns = period_ns

    def at(self, timestamp_ns: int) -> bool:
        """Whether the sensor samples at the tick of this stamp."""
        if self._always or timestamp_ns == 0:
            return True
        before = (timestamp_ns - self._period_ns) * self._top // self._bottom
        return timestamp_ns * self._top // self._bottom > before


def ticks_of(delay_s: float, period_ns: int) -> int:
    """A delay in whole ticks, to the nearest."""
    return round(delay_s * 1e9 / period_ns)


class DelayLine:
    """Delays samples. Their stamp stays that of sampling; their tick becomes that of delivery."""

    def __init__(self, ticks: int) -> None:
        self._ticks = ticks
        self._under_way: deque[tuple[int, Message]] = deque()  # with the tick of arrival

    def pass_on(self, tick: int, taken: Message | None) -> Message | None:
        """Put in the sample of this tick, if any; returns the one that arrives at it, if any."""
        if not self._ticks:
            return taken
        if taken is not None:
            self._under_way.append((tick + self._ticks, taken))
        if not self._under_way or self._under_way[0][0] > tick:
            return None
        return msgspec.structs.replace(self._under_way.popleft()[1], tick=tick)

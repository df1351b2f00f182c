"""When a sensor is due, and the delay of its samples."""

from collections import deque

import msgspec

from snakesim_hal.wire.messages import Message


class SamplingSchedule:
    """The ticks at which a sensor of a given rate samples: those at which floor(timestamp * rate) increases.

    It is computed in integers, so that no tick depends on rounding.
    """

    def __init__(self, sensor_hz: float, tick_hz: float, period_ns: int) -> None:
        self._samples_always = sensor_hz >= tick_hz
        numerator, denominator = sensor_hz.as_integer_ratio()
        self._numerator = numerator
        self._denominator = denominator * 10**9  # timestamps are in ns
        self._period_ns = period_ns

    def is_due(self, timestamp_ns: int) -> bool:
        """Return whether the sensor samples at the tick with this timestamp."""
        if self._samples_always or timestamp_ns == 0:
            return True
        samples_before = (timestamp_ns - self._period_ns) * self._numerator // self._denominator
        samples_now = timestamp_ns * self._numerator // self._denominator
        return samples_now > samples_before


def round_to_ticks(delay_s: float, period_ns: int) -> int:
    """Return a delay as a number of whole ticks, the nearest one."""
    return round(delay_s * 1e9 / period_ns)


class DelayLine:
    """Delays samples. They keep the timestamp of sampling, and get the tick of delivery."""

    def __init__(self, ticks: int) -> None:
        self._ticks = ticks
        self._waiting: deque[tuple[int, Message]] = deque()  # with the tick of delivery

    def delay(self, tick: int, sample: Message | None) -> Message | None:
        """Take in the sample of this tick, if any, and return the one that is to be delivered now, if any."""
        if not self._ticks:
            return sample
        if sample is not None:
            self._waiting.append((tick + self._ticks, sample))
        if not self._waiting:
            return None
        delivery_tick, oldest = self._waiting[0]
        if delivery_tick > tick:
            return None
        self._waiting.popleft()
        return msgspec.structs.replace(oldest, tick=tick)

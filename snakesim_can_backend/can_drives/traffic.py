"""Computes how much of a bus the frames of a driver type take, in the worst case, and refuses what does not fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_hal.base.errors import ConfigError


@dataclass(frozen=True)
class CycleTraffic:
    """Frames by their length in bytes."""

    each_drive: tuple[int, ...]  # of a tick
    one_drive: tuple[int, ...] = ()  # of a tick, and of one drive in turn
    heartbeats_hz: float = 0.0  # of a drive, of 8 bytes


@dataclass(frozen=True)
class BusLoad:
    """Of the fullest bus."""

    share: float  # of its time
    fits_hz: int
    drives: int

    def check(self, name: str, rate_hz: float, bus: str) -> None:
        """Raise ConfigError when it is too high. bus: its rate, in words."""
        if self.share > MAX_LOAD:
            raise ConfigError(
                f"{self.drives} drives at {rate_hz:g} Hz need {self.share:.0%} of a bus of {bus}, at worst-case "
                f"stuffing; at most {MAX_LOAD:.0%}: use rate_hz = {self.fits_hz}, or more `backends.{name}.channels`"
            )


def compute_load(traffic: CycleTraffic, on: Sequence[int], rate_hz: float, frame_s: Callable[[int], float]) -> BusLoad:
    """on: the number of every joint's bus; frame_s: time that a frame of so many bytes takes."""
    drives = max(on.count(bus) for bus in set(on))
    tick_s = drives * sum(map(frame_s, traffic.each_drive)) + sum(map(frame_s, traffic.one_drive))
    steady = drives * traffic.heartbeats_hz * frame_s(8) if traffic.heartbeats_hz else 0.0
    return BusLoad(tick_s * rate_hz + steady, int((MAX_LOAD - steady) / tick_s), drives)

"""Computes how much of a bus the frames of a driver type take, in the worst case, and refuses what does not fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_hal.base.errors import ConfigError

HEARTBEAT_BYTES = 8


@dataclass(frozen=True)
class CycleTraffic:
    """The frames of a driver type, by their lengths in bytes."""

    each_drive: tuple[int, ...]  # in each control cycle, for every drive
    one_drive: tuple[int, ...] = ()  # in each control cycle, for one drive in turn
    heartbeats_hz: float = 0.0  # of every drive


@dataclass(frozen=True)
class BusLoad:
    """The load of the fullest bus."""

    fraction: float  # of its time, 0 to 1
    fits_hz: int  # the highest rate that is allowed
    drives: int

    def check(self, name: str, rate_hz: float, bus: str) -> None:
        """Refuse a load that is too high.

        Args:
            name: Name of the backend.
            rate_hz: Rate of the control cycle on the bus.
            bus: Bit rate of the bus, in words.

        Raises:
            ConfigError: the load is higher than `MAX_LOAD`.
        """
        if self.fraction > MAX_LOAD:
            raise ConfigError(
                f"{self.drives} drives at {rate_hz:g} Hz need {self.fraction:.0%} of a bus of {bus}, at worst-case "
                f"stuffing; at most {MAX_LOAD:.0%}: use rate_hz = {self.fits_hz}, or more `backends.{name}.channels`",
                code="bus/overloaded",
            )


def compute_load(
    traffic: CycleTraffic, bus_indices: Sequence[int], rate_hz: float, frame_s: Callable[[int], float]
) -> BusLoad:
    """Return the load of the bus with the most drives, and the highest control rate that it allows.

    Args:
        traffic: The frames that a driver type sends and receives in each cycle.
        bus_indices: Index of the bus of every joint.
        rate_hz: Rate of the control cycle on the bus.
        frame_s: Returns the maximum time that a frame occupies the bus, from its number of data bytes.
    """
    drives = max(bus_indices.count(bus) for bus in set(bus_indices))
    each_drive_s = sum(map(frame_s, traffic.each_drive))
    one_drive_s = sum(map(frame_s, traffic.one_drive))
    cycle_s = drives * each_drive_s + one_drive_s
    heartbeat_fraction = 0.0
    if traffic.heartbeats_hz:
        heartbeat_fraction = drives * traffic.heartbeats_hz * frame_s(HEARTBEAT_BYTES)
    max_rate_hz = int((MAX_LOAD - heartbeat_fraction) / cycle_s)
    return BusLoad(cycle_s * rate_hz + heartbeat_fraction, max_rate_hz, drives)

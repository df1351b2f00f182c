"""Computes how much of a bus the frames of a driver type take, in the worst case, and refuses what does not fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_hal.base.errors import ConfigError

HEARTBEAT_BYTES = 8


@dataclass(frozen=True)
class CycleTraffic:
    """The frames of a driver type, as the number of data bytes of each frame."""

    bytes_per_drive: tuple[int, ...]  # frames in each control cycle for every drive
    bytes_per_cycle: tuple[int, ...] = ()  # frames in each control cycle for one drive in turn
    heartbeats_hz: float = 0.0  # rate of the heartbeats of every drive


@dataclass(frozen=True)
class BusLoad:
    """The load of the bus with the most drives."""

    fraction: float  # of the time of the bus, 0 to 1
    max_rate_hz: int  # highest control rate that is allowed
    drive_count: int  # drives on the bus

    def check(self, name: str, rate_hz: float, bus: str) -> None:
        """Check that the load is not higher than `MAX_LOAD`.

        Args:
            name: Name of the backend, used in the error message.
            rate_hz: Rate of the control cycle on the bus.
            bus: Bit rate of the bus in words, used in the error message.

        Raises:
            ConfigError: The load is higher than `MAX_LOAD`.
        """
        if self.fraction > MAX_LOAD:
            raise ConfigError(
                f"{self.drive_count} drives at {rate_hz:g} Hz need {self.fraction:.0%} of a bus of {bus}, at "
                f"worst-case stuffing; at most {MAX_LOAD:.0%}: use rate_hz = {self.max_rate_hz}, or more "
                f"`backends.{name}.channels`",
                code="bus/overloaded",
            )


def compute_load(
    traffic: CycleTraffic,
    bus_indices: Sequence[int],
    rate_hz: float,
    compute_frame_duration_s: Callable[[int], float],
) -> BusLoad:
    """Return the load of the bus with the most drives, and the highest control rate that it allows.

    Args:
        traffic: Frames of a driver type in each control cycle.
        bus_indices: Index of the bus of every joint.
        rate_hz: Rate of the control cycle on the bus.
        compute_frame_duration_s: Function that returns the maximum duration of a frame from its number of data bytes.
    """
    drive_count = max(bus_indices.count(bus) for bus in set(bus_indices))
    frames_per_drive_s = sum(map(compute_frame_duration_s, traffic.bytes_per_drive))
    frames_of_one_drive_in_turn_s = sum(map(compute_frame_duration_s, traffic.bytes_per_cycle))
    cycle_s = drive_count * frames_per_drive_s + frames_of_one_drive_in_turn_s
    heartbeat_fraction = 0.0  # heartbeats have a rate of their own, whatever the control rate is
    if traffic.heartbeats_hz:
        heartbeat_fraction = (
            drive_count * traffic.heartbeats_hz * compute_frame_duration_s(HEARTBEAT_BYTES)
        )
    max_rate_hz = int((MAX_LOAD - heartbeat_fraction) / cycle_s)
    return BusLoad(
        fraction=cycle_s * rate_hz + heartbeat_fraction,
        max_rate_hz=max_rate_hz,
        drive_count=drive_count,
    )

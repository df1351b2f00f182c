"""How long the servos of a serial port occupy it in a control cycle, at worst, for any protocol. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_hal.base.errors import ConfigError
from snakesim_serial_backend.wire import BITS_PER_BYTE, USB_LATENCY_S

MAX_LOAD = 0.8  # of a period
REQUESTS = 2  # in a cycle that are answered; each waits once for the adapter


@dataclass(frozen=True)
class PortLoad:
    """Bytes, time and rate of a cycle on a port, by one protocol."""

    rates: Sequence[int]  # possible baud rates in bit/s
    # On the wire, in both directions, from the number of servos.
    count_cycle_bytes: Callable[[int], int]
    cycle: str  # the requests of a cycle, in words

    @property
    def note(self) -> str:
        """What the numbers of the load table are."""
        return (
            f"A cycle on one port: {self.cycle}; an adapter's latency of 1 ms for each of two questions; the fastest "
            f"rate at which it takes {MAX_LOAD:.0%} of a period"
        )

    def compute_cycle_duration_s(self, servo_count: int, baud: int) -> float:
        """Return how long a port is busy, or waits, in a cycle."""
        return self.count_cycle_bytes(servo_count) * BITS_PER_BYTE / baud + REQUESTS * USB_LATENCY_S

    def compute_max_rate_hz(self, servo_count: int, baud: int) -> int:
        """Return the fastest possible control rate, in whole Hz."""
        return int(MAX_LOAD / self.compute_cycle_duration_s(servo_count, baud))

    def check(self, servo_count: int, rate_hz: float, baud: int, section: str) -> None:
        """Check that a port can carry its servos.

        Args:
            servo_count: Number of servos on the port.
            rate_hz: Rate of the control cycle.
            baud: Baud rate of the port in bit/s.
            section: Dotted name of the settings section, used in error messages.

        Raises:
            ConfigError: A cycle takes more than `MAX_LOAD` of a control period.
        """
        busy_s = self.compute_cycle_duration_s(servo_count, baud)
        if busy_s * rate_hz > MAX_LOAD:
            raise ConfigError(
                f"{servo_count} servos at {rate_hz:g} Hz: a cycle of {self.count_cycle_bytes(servo_count)} bytes takes "
                f"{busy_s * 1e3:.1f} ms at {baud} baud, which is {busy_s * rate_hz:.0%} of a period; at "
                f"most {MAX_LOAD:.0%}: use rate_hz = {self.compute_max_rate_hz(servo_count, baud)}, a higher "
                f"`{section}.baud`, or more `{section}.ports`",
                code="bus/overloaded",
            )

"""The tick of a host, and the times that belong to it."""

import time

from snakesim_hal.host.simulated_time import SimulatedTime
from snakesim_hal.host.timing import TickDeadlines
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import ClockMode, RobotDescription


class HostClock:
    """Counts the ticks of one host.

    `clock_mode` is the run's, except after a fault: then the host no longer waits for services.
    """

    def __init__(self, config: RunConfig, description: RobotDescription) -> None:
        self.tick = 0
        self.period_ns = config.period_ns
        self.clock_mode: ClockMode = config.clock_mode
        self.simulated = SimulatedTime(description, config.clock_mode, time.monotonic_ns)
        self.deadlines = TickDeadlines(config.period_ns)

    @property
    def timestamp_ns(self) -> int:
        """Robot time of the present tick, in ns."""
        return self.tick * self.period_ns

    def safety_ns(self, monotonic_ns: int | None = None) -> int:
        """Return the time in which leases and ages count, in ns.

        It is simulated time in lockstep, and otherwise the monotonic clock, except for pauses.

        Args:
            monotonic_ns: The moment; None means now.
        """
        return self.simulated.safety_ns(self.tick, monotonic_ns)

    def restart_deadlines(self, speed: float | None = None) -> None:
        """Let the present tick begin now. `speed` is that of robot time from now on; None keeps it."""
        self.deadlines.begin(self.tick, speed)

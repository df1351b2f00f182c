"""Compares how long a controller computes with the time that it has on a real robot.

A run that is not in real time has no deadlines, and would not show that the controller misses them.
"""

from snakesim_hal.wire.messages import RobotDescription

# A busy computer delays some updates: so many late ones are accepted.
MAX_LATE_FRACTION = 0.1
MAX_LATE_UPDATES = 2


class UpdateTimes:
    """The wall-clock times of one controller's updates."""

    def __init__(self, robot: RobotDescription) -> None:
        """Start without any update."""
        self._period_s = robot.period_ns * 1e-9
        self._lease_s = robot.lease_ns * 1e-9
        self._update_count = 0
        self._late_count = 0  # updates that took longer than a period
        self._max_duration_s = 0.0

    def add_duration(self, duration_s: float) -> None:
        """Add the duration of an update."""
        self._update_count += 1
        if duration_s > self._period_s:
            self._late_count += 1
        self._max_duration_s = max(self._max_duration_s, duration_s)

    @property
    def too_slow_reason(self) -> str:
        """Why the controller is too slow for real time, with the measured times; empty if it is fast enough.

        An update that takes longer than one lease stops the robot. So does a queue of late updates.
        """
        max_late = max(MAX_LATE_UPDATES, MAX_LATE_FRACTION * self._update_count)
        outlasts_lease = self._max_duration_s > self._lease_s
        if not outlasts_lease and self._late_count <= max_late:
            return ""
        longest_text = (
            f"update() took {_format_ms(self._max_duration_s)} of {_format_ms(self._period_s)}"
        )
        if self._update_count == 1:
            return longest_text
        return f"{longest_text}; {self._late_count} of {self._update_count} updates took longer than a period"


def _format_ms(time_s: float) -> str:
    """Return a time in ms: whole from 10 ms on, with two digits below."""
    time_ms = 1e3 * time_s
    if time_s >= 0.01:
        return f"{time_ms:.0f} ms"
    return f"{time_ms:.2g} ms"

"""How long a controller computes, against the time that the robot leaves it: a run without deadlines hides that."""

from snakesim_hal.wire.messages import Description

LATE_FRACTION, FEW = 0.1, 2  # of the updates, and in number: a busy computer delays some


class UpdateTimes:
    """The wall-clock times of one controller's updates."""

    def __init__(self, robot: Description) -> None:
        """Start without any update."""
        self._period_s = robot.period_ns * 1e-9
        self._lease_s = robot.lease_ns * 1e-9
        self._updates = 0
        self._late = 0  # updates that took longer than a period
        self._longest_s = 0.0

    def add(self, took_s: float) -> None:
        """Count an update."""
        self._updates += 1
        self._late += took_s > self._period_s
        self._longest_s = max(self._longest_s, took_s)

    @property
    def too_slow(self) -> str:
        """What shows that the controller is too slow for real time; empty when nothing does.

        One update that takes longer than a lease stops a robot, and so does a queue of late ones.
        """
        often = self._late > max(FEW, LATE_FRACTION * self._updates)
        if not often and self._longest_s <= self._lease_s:
            return ""
        longest = f"update() took {_milliseconds(self._longest_s)} of {_milliseconds(self._period_s)}"
        if self._updates == 1:
            return longest
        return f"{longest}; {self._late} of {self._updates} updates took longer than a period"


def _milliseconds(time_s: float) -> str:
    return f"{1e3 * time_s:.0f} ms" if time_s >= 0.01 else f"{1e3 * time_s:.2g} ms"

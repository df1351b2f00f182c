"""How long a run waits for a robot that is on, with every service there, and yet cannot be armed."""

from collections.abc import Collection

from snakesim_hal.wire.messages import Status

# No status for longer than this means that the host or this process is slow, so the robot did not use that time.
MAX_STEP_S = 1.0


class StartupTimeout:
    """Counts the time in which the robot could have become ready, and did not.

    This is robot time. Where robot time is paused, as in lockstep before the arming, it is the time in which the host
    sends its status. The count starts again with each service that starts, so that a slow computer has the whole time
    for each part.
    """

    def __init__(self, services: Collection[str], limit_s: float) -> None:
        """Begin to count. services: all that the robot needs; limit_s: the time allowed."""
        self.limit_s = limit_s
        self._services = frozenset(services)
        self._last_status: Status | None = None
        self._last_arrival_s = 0.0
        self._waited_s = 0.0

    def ends(self, status: Status | None, now_s: float) -> bool:
        """Count the time that has passed up to a status, and return whether it exceeds the limit.

        While ticks advance, robot time is counted. Otherwise wall time is counted, at most MAX_STEP_S for each status.

        Args:
            status: The newest status of the host; None before the first.
            now_s: Time of a monotonic clock in seconds.
        """
        previous = self._last_status
        if status is None or status is previous:
            return False
        since_arrival_s = now_s - self._last_arrival_s
        self._last_status = status
        self._last_arrival_s = now_s
        if previous is None or self._starts_again(previous, status):
            self._waited_s = 0.0
        elif status.tick > previous.tick:
            self._waited_s += (status.timestamp_ns - previous.timestamp_ns) * 1e-9
        else:
            self._waited_s += min(since_arrival_s, MAX_STEP_S)
        return self._waited_s > self.limit_s

    def _starts_again(self, last: Status, status: Status) -> bool:
        """Return whether the robot is ready, a service is missing, or something has changed since the last status."""
        if status.ready_to_arm or self._services.difference(status.alive):
            return True
        return (status.alive, status.waiting_for) != (last.alive, last.waiting_for)

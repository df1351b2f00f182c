"""Limits the time that a run waits for a robot whose services are all alive, but which cannot be armed."""

from collections.abc import Collection

from snakesim_hal.wire.messages import RobotStatus

# A longer pause between two statuses means that the host or this process is slow, so the excess does not count.
MAX_STATUS_PERIOD_S = 1.0


class StartupTimeout:
    """Counts the time in which the robot could have become ready to arm, but did not.

    Robot time is counted. While robot time is paused, as in lockstep before the arming, the time between statuses of
    the host is counted instead. The count restarts with each service that starts, so that a slow computer has the whole
    timeout for each of them.
    """

    def __init__(self, services: Collection[str], timeout_s: float) -> None:
        """Start to count.

        Args:
            services: Names of all services that the robot needs.
            timeout_s: Time after which waiting ends, in s.
        """
        self.timeout_s = timeout_s
        self._services = frozenset(services)
        self._last_status: RobotStatus | None = None
        self._last_arrival_s = 0.0
        self._elapsed_s = 0.0

    def update_and_check_expired(self, status: RobotStatus | None, now_s: float) -> bool:
        """Add the time since the previous status, and return whether the sum exceeds the timeout.

        While ticks advance, robot time (the timestamps of the statuses) is added. Otherwise real time is added, at most
        MAX_STATUS_PERIOD_S for each status. Without a new status, nothing is added, and the result is False.

        Args:
            status: Newest status of the host; None before the first one.
            now_s: Time of a monotonic clock, in s.
        """
        previous = self._last_status
        if status is None or status is previous:
            return False
        elapsed_s = now_s - self._last_arrival_s
        self._last_status = status
        self._last_arrival_s = now_s
        if previous is None or self._should_restart(previous, status):
            self._elapsed_s = 0.0
        elif status.tick > previous.tick:
            self._elapsed_s += (status.timestamp_ns - previous.timestamp_ns) * 1e-9
        else:
            self._elapsed_s += min(elapsed_s, MAX_STATUS_PERIOD_S)
        return self._elapsed_s > self.timeout_s

    def _should_restart(self, last_status: RobotStatus, status: RobotStatus) -> bool:
        """Return whether the count restarts: the robot is ready, a service is missing, or the services have changed."""
        if status.ready_to_arm or self._services.difference(status.alive):
            return True
        return (status.alive, status.waiting_for) != (last_status.alive, last_status.waiting_for)

"""How long a run waits for a robot that is on, with every service there, and yet cannot be armed."""

from collections.abc import Collection

from snakesim_hal.wire.messages import Status

MOST_AT_ONCE_S = 1.0  # while a status does not come, the host or this process is slow: nobody waits for the robot


class StartupTimeout:
    """Counts robot time; where that stands still, as in lockstep before the arming, time in which the host is heard.

    It starts again with whatever comes, so that a slow computer has the whole time for each part.
    """

    def __init__(self, services: Collection[str], limit_s: float) -> None:
        self._services, self.limit_s = frozenset(services), limit_s
        self._last: Status | None = None
        self._heard_s = self._waited_s = 0.0

    def ends(self, status: Status | None, now_s: float) -> bool:
        """Whether it is over. status: the newest one; now_s: time of a steady clock."""
        last = self._last
        if status is None or status is last:
            return False
        heard_s, self._last, self._heard_s = self._heard_s, status, now_s
        if (
            last is None
            or status.ready_to_arm
            or self._services.difference(status.alive)
            or (status.alive, status.waiting_for) != (last.alive, last.waiting_for)
        ):
            self._waited_s = 0.0
        elif status.tick > last.tick:
            self._waited_s += (status.timestamp_ns - last.timestamp_ns) * 1e-9
        else:
            self._waited_s += min(now_s - heard_s, MOST_AT_ONCE_S)
        return self._waited_s > self.limit_s

"""The speed and the direction that an operator requests, as intents. Pure."""

import math

from snakesim_hal.wire.messages import Intent

VALID_NS = 500_000_000  # in robot time; ten times as long as the period in which intents are repeated
SPEED_STEP_M_S = 0.05
HEADING_STEP_RAD = math.radians(10)
TURN_RAD_S = 0.8  # with the stick fully to one side
LEAD_RAD = math.pi / 2  # the requested direction is ahead of the body's by at most this


class Steering:
    """Speed and direction, changed by keys or by a stick."""

    def __init__(self, requester: str, fastest_m_s: float) -> None:
        self._requester = requester
        self._max_speed_m_s = fastest_m_s
        self.speed_m_s = 0.0
        self.heading_w_rad: float | None = None  # None: the mission's own goal
        self.touched_s: float | None = None  # monotonic time of the operator's last input; None: no input yet

    def change_speed(self, steps: int, now_s: float) -> None:
        """Change the speed by steps; negative steps decrease it, down to full speed backwards."""
        self.set_speed_fraction((self.speed_m_s + steps * SPEED_STEP_M_S) / self._max_speed_m_s, now_s)

    def set_speed_fraction(self, fraction: float, now_s: float) -> None:
        """Request a fraction of the maximum speed, from -1 to 1. now_s: when the operator requested it."""
        limited = max(-1.0, min(1.0, fraction))
        self.speed_m_s = round(limited * self._max_speed_m_s, 3) + 0.0  # + 0.0 turns -0.0 into 0.0
        self.touched_s = now_s

    def rotate_heading(self, by_rad: float, body_w_rad: float | None, now_s: float) -> None:
        """Rotate the requested direction, positive to the left.

        The first rotation starts at the direction of the body, or at 0 if that is unknown.
        """
        start_w_rad = self.heading_w_rad
        if start_w_rad is None:
            start_w_rad = body_w_rad or 0.0
        self.heading_w_rad = rotate_heading(start_w_rad, by_rad, body_w_rad)
        self.touched_s = now_s

    def stop(self, now_s: float) -> None:
        """Request speed 0; the direction stays."""
        self.speed_m_s = 0.0
        self.touched_s = now_s

    def intent(self, robot_ns: int) -> Intent:
        """Return the request as a message. robot_ns: the present robot time."""
        return Intent(
            timestamp_ns=robot_ns,
            requester=self._requester,
            speed_m_s=self.speed_m_s,
            go=self.speed_m_s != 0.0,
            valid_for_ns=VALID_NS,
            heading_w_rad=self.heading_w_rad,
        )


def rotate_heading(heading_w_rad: float, by_rad: float, body_w_rad: float | None) -> float:
    """Return a direction after a rotation, limited to LEAD_RAD to either side of the body.

    Args:
        heading_w_rad: the direction before.
        by_rad: the rotation, positive to the left.
        body_w_rad: direction of the body; None if unknown, then only the rotation is limited.
    """
    body = heading_w_rad if body_w_rad is None else body_w_rad
    ahead = math.remainder(heading_w_rad + by_rad - body, 2 * math.pi)
    limited = max(-LEAD_RAD, min(LEAD_RAD, ahead))
    return math.remainder(body + limited, 2 * math.pi)

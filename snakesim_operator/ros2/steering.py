"""From geometry_msgs/Twist on /cmd_vel to intents. Pure except for its own state.

`linear.x` is the speed along the body, `angular.z` turns the wanted direction of travel; a Twist with neither stops the
robot. Every Twist becomes one intent of short validity, so a ROS side that falls silent stops the robot.
"""

import math

from snakesim_hal.wire.messages import Intent
from snakesim_operator.ros2.messages import six_doubles

VALID_NS = 500_000_000  # of an intent in robot time; teleop_twist_keyboard and joysticks repeat at 10 Hz and more
FASTEST_M_S = 10.0  # as navigation's limit of an intent
QUICKEST_RAD_S = 10.0
LEAD_RAD = math.pi / 2  # the wanted direction runs ahead of the body by at most this
WHO = "ros2 /cmd_vel"


class Steering:
    """The direction of travel that /cmd_vel has asked for so far."""

    def __init__(self) -> None:
        self._heading_w_rad: float | None = None
        self._last_ns: int | None = None
        self.rejected = 0  # of Twists that were malformed, not finite, or out of bounds

    def intent(self, payload: bytes, now_ns: int, body_w_rad: float | None) -> Intent | None:
        """What a Twist asks for; None: it is rejected, and counted.

        now_ns: robot time; body_w_rad: heading of the body in the world, None while it is unknown.
        """
        numbers = six_doubles(payload)
        if numbers is None or not all(map(math.isfinite, numbers)):
            self.rejected += 1
            return None
        speed_m_s, turn_rad_s = numbers[0], numbers[5]
        if abs(speed_m_s) > FASTEST_M_S or abs(turn_rad_s) > QUICKEST_RAD_S:
            self.rejected += 1
            return None
        self._turn(turn_rad_s, now_ns, body_w_rad)
        return Intent(
            stamp_ns=now_ns,
            who=WHO,
            speed_m_s=speed_m_s,
            go=speed_m_s != 0.0,
            valid_for_ns=VALID_NS,
            heading_w_rad=self._heading_w_rad,
        )

    def _turn(self, turn_rad_s: float, now_ns: int, body_w_rad: float | None) -> None:
        """Turn the wanted direction for the time since the last Twist; again from the body's after a silence."""
        since_ns = VALID_NS + 1 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns
        if self._heading_w_rad is None or not 0 <= since_ns <= VALID_NS:
            self._heading_w_rad = body_w_rad
        elif body_w_rad is not None:
            ahead = self._heading_w_rad + turn_rad_s * since_ns * 1e-9 - body_w_rad
            ahead = math.remainder(ahead, 2 * math.pi)
            self._heading_w_rad = body_w_rad + min(max(ahead, -LEAD_RAD), LEAD_RAD)

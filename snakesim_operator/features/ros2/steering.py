"""From geometry_msgs/Twist on /cmd_vel to intents. Pure except for its own state.

`linear.x` is the speed along the body, `angular.z` turns the wanted direction of travel; a Twist with neither stops the
robot. Every Twist becomes one intent of short validity, from when it was sent on. So a ROS side that falls silent stops
the robot, and one that was held back moves nothing.
"""

import math

from snakesim_hal.wire.messages import Intent
from snakesim_operator.features.ros2.message_age import why_too_old
from snakesim_operator.features.ros2.messages import six_doubles

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
        self.rejected = 0  # Twists that were malformed, not finite, out of bounds, or too old
        self.why = ""  # the newest one was

    def intent(self, payload: bytes, now_ns: int, body_w_rad: float | None, age_ns: int = 0) -> Intent | None:
        """Return what a Twist asks for; None: it is rejected, and counted.

        Args:
            payload: The Twist in CDR.
            now_ns: Robot time.
            body_w_rad: Heading of the body in the world; None while it is unknown.
            age_ns: How long ago the Twist was sent.
        """
        numbers = six_doubles(payload)
        why = _why_rejected(numbers)
        stops = numbers is not None and numbers[0] == 0.0
        if stops:
            age_ns = 0  # a stop counts however late it comes
        why = why or why_too_old(age_ns, "the times of its sender's messages")
        if why or numbers is None:
            self.rejected, self.why = self.rejected + 1, why
            return None
        speed_m_s, turn_rad_s = numbers[0], numbers[5]
        self._turn(turn_rad_s, now_ns, body_w_rad)
        return Intent(
            timestamp_ns=max(now_ns - age_ns, 0),
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


def _why_rejected(numbers: tuple[float, ...] | None) -> str:
    """Return what is wrong with the numbers of a Twist; empty when nothing is."""
    if numbers is None:
        return "is no geometry_msgs/Twist"
    if not all(map(math.isfinite, numbers)):
        return "has numbers that are not finite"
    if abs(numbers[0]) > FASTEST_M_S or abs(numbers[5]) > QUICKEST_RAD_S:
        return f"asks for more than {FASTEST_M_S:g} m/s or {QUICKEST_RAD_S:g} rad/s"
    return ""

"""The speed and the direction that an operator requests, as intents. Pure."""

import math

from snakesim_hal.wire.messages import LocomotionIntent

# In robot time; ten times as long as the period in which intents are repeated.
INTENT_VALIDITY_NS = 500_000_000
SPEED_STEP_M_S = 0.05
HEADING_STEP_RAD = math.radians(10)
TURN_RAD_S = 0.8  # with the stick fully to one side
# The requested direction is ahead of the body's by at most this.
MAX_HEADING_OFFSET_RAD = math.pi / 2


class SteeringState:
    """Speed and direction, changed by keys or by a stick."""

    def __init__(self, requester: str, max_speed_m_s: float) -> None:
        self._requester = requester
        self._max_speed_m_s = max_speed_m_s
        self.speed_m_s = 0.0
        self.heading_w_rad: float | None = None  # None: the mission's own goal
        # Monotonic time of the operator's last input; None: no input yet.
        self.last_input_s: float | None = None

    def change_speed(self, step_count: int, now_s: float) -> None:
        """Change the requested speed by steps of SPEED_STEP_M_S, within the maximum speed in both directions.

        Args:
            step_count: Number of steps; negative steps decrease the speed.
            now_s: Monotonic time of the operator's input.
        """
        self.set_speed_fraction(
            (self.speed_m_s + step_count * SPEED_STEP_M_S) / self._max_speed_m_s, now_s
        )

    def set_speed_fraction(self, fraction: float, now_s: float) -> None:
        """Request a fraction of the maximum speed.

        Args:
            fraction: Fraction from -1, full speed backwards, to 1; values beyond are limited.
            now_s: Monotonic time of the operator's input.
        """
        limited = max(-1.0, min(1.0, fraction))
        self.speed_m_s = round(limited * self._max_speed_m_s, 3) + 0.0  # + 0.0 turns -0.0 into 0.0
        self.last_input_s = now_s

    def rotate_heading(
        self, rotation_rad: float, body_heading_w_rad: float | None, now_s: float
    ) -> None:
        """Rotate the requested heading. The first rotation starts at the heading of the body.

        Args:
            rotation_rad: Angle of the rotation, positive to the left.
            body_heading_w_rad: Heading of the body in the world; None if it is unknown, which counts as 0.
            now_s: Monotonic time of the operator's input.
        """
        start_w_rad = self.heading_w_rad
        if start_w_rad is None:
            start_w_rad = body_heading_w_rad or 0.0
        self.heading_w_rad = compute_limited_heading(start_w_rad, rotation_rad, body_heading_w_rad)
        self.last_input_s = now_s

    def stop(self, now_s: float) -> None:
        """Request speed 0, and keep the requested heading."""
        self.speed_m_s = 0.0
        self.last_input_s = now_s

    def make_intent(self, robot_time_ns: int) -> LocomotionIntent:
        """Return the operator's request as an Intent message, which expires after INTENT_VALIDITY_NS.

        Args:
            robot_time_ns: Current robot time.
        """
        return LocomotionIntent(
            timestamp_ns=robot_time_ns,
            requester=self._requester,
            speed_m_s=self.speed_m_s,
            go=self.speed_m_s != 0.0,
            valid_for_ns=INTENT_VALIDITY_NS,
            heading_w_rad=self.heading_w_rad,
        )


def compute_limited_heading(
    heading_w_rad: float, rotation_rad: float, body_heading_w_rad: float | None
) -> float:
    """Return a heading after a rotation, limited to MAX_HEADING_OFFSET_RAD to either side of the body's heading.

    Args:
        heading_w_rad: Heading before the rotation, in the world.
        rotation_rad: Angle of the rotation, positive to the left.
        body_heading_w_rad: Heading of the body in the world. If None, it is unknown, and only the rotation is limited.
    """
    reference_w_rad = heading_w_rad if body_heading_w_rad is None else body_heading_w_rad
    offset_rad = math.remainder(heading_w_rad + rotation_rad - reference_w_rad, 2 * math.pi)
    limited_offset_rad = max(-MAX_HEADING_OFFSET_RAD, min(MAX_HEADING_OFFSET_RAD, offset_rad))
    return math.remainder(reference_w_rad + limited_offset_rad, 2 * math.pi)

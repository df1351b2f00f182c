"""What the operator asks for, as intents. Pure."""

import math

from snakesim_hal.wire.messages import Intent

VALID_NS = 500_000_000  # in robot time; ten times as long as the period in which intents are repeated
SPEED_STEP_M_S, HEADING_STEP_RAD = 0.05, math.radians(10)
TURN_RAD_S = 0.8  # with the stick fully to one side
LEAD_RAD = math.pi / 2  # the wanted direction runs ahead of the body's by at most this


class Steering:
    """Speed and direction, changed by keys or by a stick."""

    def __init__(self, who: str, fastest_m_s: float) -> None:
        self._who, self._fastest_m_s = who, fastest_m_s
        self.speed_m_s = 0.0
        self.heading_w_rad: float | None = None  # None: the mission's own goal
        self.touched_s: float | None = None  # when the operator did something last, monotonic; None: not yet

    def faster(self, steps: int, now_s: float) -> None:
        """Change the speed by steps; negative ones are slower, then backwards."""
        self.push((self.speed_m_s + steps * SPEED_STEP_M_S) / self._fastest_m_s, now_s)

    def push(self, share: float, now_s: float) -> None:
        """Ask for a share of the fastest speed, from -1 to 1. now_s: when the operator did."""
        self.speed_m_s = round(max(-1.0, min(1.0, share)) * self._fastest_m_s, 3) + 0.0
        self.touched_s = now_s

    def turn(self, by_rad: float, body_w_rad: float | None, now_s: float) -> None:
        """Turn the wanted direction, positive to the left; at first from the body's, when that is known."""
        before = body_w_rad or 0.0 if self.heading_w_rad is None else self.heading_w_rad
        self.heading_w_rad, self.touched_s = turned(before, by_rad, body_w_rad), now_s

    def stop(self, now_s: float) -> None:
        """Stand still; the direction stays."""
        self.speed_m_s, self.touched_s = 0.0, now_s

    def intent(self, robot_ns: int) -> Intent:
        """At a robot time."""
        return Intent(
            timestamp_ns=robot_ns,
            who=self._who,
            speed_m_s=self.speed_m_s,
            go=self.speed_m_s != 0.0,
            valid_for_ns=VALID_NS,
            heading_w_rad=self.heading_w_rad,
        )


def turned(heading_w_rad: float, by_rad: float, body_w_rad: float | None) -> float:
    """A wanted direction after a turn, positive to the left; it runs ahead of the body's, if known, by a limit."""
    body = heading_w_rad if body_w_rad is None else body_w_rad
    ahead = math.remainder(heading_w_rad + by_rad - body, 2 * math.pi)
    return math.remainder(body + max(-LEAD_RAD, min(LEAD_RAD, ahead)), 2 * math.pi)

"""Measures the recent displacement of the body, from the positions that guidance publishes."""

import math
from collections import deque

from snakesim_hal.model.locomotion import WINDOW_S
from snakesim_hal.wire.quantities import Vector

SMOOTHING_S = 0.1  # time constant of the low-pass filter that removes pose noise from the center


class RecentAdvance:
    """Tracks the body's center of mass over a sliding window. It hardly moves while the body only wriggles."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, Vector]] = deque()  # time in s and smoothed center in m, over WINDOW_S

    def add(self, time_s: float, center_w: Vector) -> None:
        """Add the center of mass at a time; ignore a time that is not later than the last one.

        A low-pass filter smooths the centers: c = center + exp(-dt / SMOOTHING_S) (c_last - center). Centers that are
        older than WINDOW_S are dropped.

        Args:
            time_s: time of the measurement.
            center_w: (2,) x and y of the body's center of mass in the world, m.
        """
        recent = self._recent
        if recent and time_s <= recent[-1][0]:
            return
        smoothed_w = center_w
        if recent and time_s - recent[-1][0] <= WINDOW_S:
            last_s, last_w = recent[-1]
            last_gain = math.exp(-(time_s - last_s) / SMOOTHING_S)
            smoothed_w = _blend(center_w, last_w, last_gain)
        else:
            recent.clear()  # the last center is too old to be compared with this one
        recent.append((time_s, smoothed_w))
        while time_s - recent[0][0] > WINDOW_S:
            recent.popleft()

    @property
    def distance_m(self) -> float | None:
        """Distance of the center from where it was a window ago, or at the first time; None if it was never known."""
        if not self._recent:
            return None
        _, first_w = self._recent[0]
        _, last_w = self._recent[-1]
        return math.dist(first_w, last_w)


def _blend(new_w: Vector, last_w: Vector, keep: float) -> Vector:
    """Return the point that lies at the fraction `keep` of the way from a new point to the last one."""
    x, y, z = new_w
    last_x, last_y, last_z = last_w
    return x + keep * (last_x - x), y + keep * (last_y - y), z + keep * (last_z - z)

"""Measures the recent displacement of the body, from the positions that guidance publishes."""

import math
from collections import deque

from snakesim_hal.model.locomotion import WINDOW_S
from snakesim_hal.wire.quantities import Vector

# Time constant of the low-pass filter that removes pose noise from the center.
FILTER_TIME_CONSTANT_S = 0.1


class RecentAdvance:
    """Tracks the body's center of mass over a sliding window. It hardly moves while the body only wriggles."""

    def __init__(self) -> None:
        # Time in s and smoothed center in m, over WINDOW_S.
        self._recent_centers: deque[tuple[float, Vector]] = deque()

    def add_center(self, time_s: float, center_w: Vector) -> None:
        """Add the center of mass at a time; ignore a time that is not later than the last one.

        A low-pass filter smooths the centers: c = center + decay (c_last - center), with
        decay = exp(-dt / FILTER_TIME_CONSTANT_S). Centers that are older than WINDOW_S are dropped.

        Args:
            time_s: Time of the measurement.
            center_w: (2,) x and y of the body's center of mass in the world, m.
        """
        recent_centers = self._recent_centers
        if recent_centers and time_s <= recent_centers[-1][0]:
            return
        filtered_w = center_w
        if recent_centers and time_s - recent_centers[-1][0] <= WINDOW_S:
            last_s, last_w = recent_centers[-1]
            decay = math.exp(-(time_s - last_s) / FILTER_TIME_CONSTANT_S)
            filtered_w = _interpolate_to_last(center_w, last_w, decay)
        else:
            recent_centers.clear()  # the last center is too old to be compared with this one
        recent_centers.append((time_s, filtered_w))
        while time_s - recent_centers[0][0] > WINDOW_S:
            recent_centers.popleft()

    @property
    def distance_m(self) -> float | None:
        """Distance of the center from where it was a window ago, or at the first time; None if it was never known."""
        if not self._recent_centers:
            return None
        _, first_w = self._recent_centers[0]
        _, last_w = self._recent_centers[-1]
        return math.dist(first_w, last_w)


def _interpolate_to_last(new_w: Vector, last_w: Vector, decay: float) -> Vector:
    """Return the point that lies at the fraction `decay` of the way from a new point to the last one."""
    x, y, z = new_w
    last_x, last_y, last_z = last_w
    return x + decay * (last_x - x), y + decay * (last_y - y), z + decay * (last_z - z)

"""Detects that a body is stationary, from the displacement of its center.

The speed along the path cannot show it: with 5 mm of noise in a pose, that is hardly ever below 1 cm/s for a whole
second.
"""

from collections import deque

import numpy as np

from snakesim_hal.base.arrays import Floats

# Time constant of the low-pass filter that removes pose noise from the body's center.
CENTER_FILTER_S = 0.2


class StandstillDetector:
    """Watches the displacement of a body's center over a sliding window."""

    def __init__(self, window_s: float) -> None:
        """Start with an empty window.

        Args:
            window_s: Duration for which the body must not move; 0 to never detect a standstill.
        """
        self._window_s = window_s
        self._filtered_centers = deque[tuple[float, Floats]]()  # time in s, filtered center (2,)

    def reset(self) -> None:
        """Start a new window."""
        self._filtered_centers = deque[tuple[float, Floats]]()

    def update(
        self, time_s: float, period_s: float, center_w: Floats, max_distance_m: float
    ) -> bool:
        """Add the center of the body at this tick, and decide whether the body is stationary.

        Call it in every tick. The centers are low-pass filtered.

        Args:
            time_s: Time of the tick.
            period_s: Time since the last tick.
            center_w: (2,) m, center of the body.
            max_distance_m: A body whose center moved less than this within the whole window is stationary.

        Returns:
            Whether the body is stationary; False until the window is filled once.
        """
        if self._window_s == 0.0:
            return False
        filtered_centers = self._filtered_centers
        last_w = center_w
        if filtered_centers:
            _, last_w = filtered_centers[-1]
        filtered_w = last_w + min(period_s / CENTER_FILTER_S, 1.0) * (center_w - last_w)
        filtered_centers.append((time_s, filtered_w))
        while len(filtered_centers) > 1 and time_s - filtered_centers[1][0] >= self._window_s:
            filtered_centers.popleft()
        first_s, first_w = filtered_centers[0]
        window_is_full = time_s - first_s >= self._window_s
        return window_is_full and float(np.hypot(*(filtered_w - first_w))) < max_distance_m

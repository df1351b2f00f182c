"""Recent displacement of the body, from guidance's measurements. Pure except for its own state."""

import math
from collections import deque

from snakesim_hal.model.locomotion import WINDOW_S
from snakesim_hal.wire.quantities import Vector

SMOOTHED_S = 0.1  # time constant: filters the noise of the pose


class Advance:
    """Tracks the body's center of mass, which hardly moves when the body only wriggles."""

    def __init__(self) -> None:
        self._recent: deque[tuple[float, Vector]] = deque()  # time, smoothed center; a window long

    def put(self, time_s: float, center_w: Vector) -> None:
        """The center at a time; times must grow."""
        recent = self._recent
        if recent and time_s <= recent[-1][0]:
            return
        smooth = center_w
        if not recent or time_s - recent[-1][0] > WINDOW_S:
            recent.clear()
        else:
            last_s, (a, b, c) = recent[-1]
            keep, (x, y, z) = math.exp(-(time_s - last_s) / SMOOTHED_S), center_w
            smooth = (x + keep * (a - x), y + keep * (b - y), z + keep * (c - z))
        recent.append((time_s, smooth))
        while time_s - recent[0][0] > WINDOW_S:
            recent.popleft()

    @property
    def metres(self) -> float | None:
        """Distance of the center from its position a window ago, or at the first time; None: it was never known."""
        if not self._recent:
            return None
        return math.dist(self._recent[0][1], self._recent[-1][1])

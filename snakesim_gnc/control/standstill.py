"""Whether a body stands: told from the way that its middle has come, not from a speed.

With 5 mm of noise in a pose, a speed along the path is hardly ever below 1 cm/s for a whole second.
"""

from collections import deque

import numpy as np

from snakesim_hal.base.arrays import Floats

MIDDLE_S = 0.2  # time constant in which the noise of poses is taken out of the middle of the body


class Standstill:
    """Watches the middle of a body for some time."""

    def __init__(self, after_s: float) -> None:
        """after_s: in which it has to stand; 0: it is never seen to."""
        self._after_s = after_s
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._way = deque[tuple[float, Floats]]()  # instants in s, and where the middle was, less noise

    def seen(self, time_s: float, period_s: float, middle_w: Floats, within_m: float) -> bool:
        """Whether the middle, (2,), has moved less than this for as long. To be asked at every tick."""
        if self._after_s == 0.0:
            return False
        way = self._way
        before_w = way[-1][1] if way else middle_w
        now_w = before_w + min(period_s / MIDDLE_S, 1.0) * (middle_w - before_w)
        way.append((time_s, now_w))
        while len(way) > 1 and time_s - way[1][0] >= self._after_s:
            way.popleft()
        then_s, then_w = way[0]
        return time_s - then_s >= self._after_s and float(np.hypot(*(now_w - then_w))) < within_m

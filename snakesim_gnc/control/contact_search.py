"""Search for contacts: a body that does not come on moves by waves for a while, to where it may push again.

Whether contacts would allow a push does not matter: a body that they hold does not come on either, and one that could
push where it lies mostly stands again a moment later. Navigation plans a new path from wherever the wave leads.

There are two waves. One feels its way (`felt_wave.py`) and pushes off whatever it meets; where it meets nothing it goes
backward, because on ground whose friction is the same in every direction a body moves the way that its wave travels.
The other one travels from tail to head; by itself it comes on at 8 cm/s, and obstacles hold it. A search begins with
the first if obstacles are near, and changes to the other one whenever the goal has come no nearer for a while.

A body that has come on by pushing lies bent among obstacles. There the wave that feels its way begins at half its
speed, which takes less energy; once that has led nowhere, it goes on as fast as it was trained.
"""

import math

import numpy as np
from msgspec.structs import replace

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.felt_wave import FeltWave, spacings
from snakesim_gnc.control.standstill import Standstill
from snakesim_gnc.control.undulation import HeadSteeredUndulation, LateralUndulation
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description

STANDS_M = 0.02  # a body stands that comes no further than this, or than half of what it is to if that is less
LEADS_M, LEADS_S = 0.05, 3.0  # nearer to the goal within this time; a wave that does less leads nowhere
PUSHED_M = 0.1  # a body that has come so far since the last search has come on by pushing
SLOWER = 2.0  # times as long takes what the first wave of such a body does
TO_HEAD = HeadSteeredUndulation.Settings(amplitude_rad=0.7, period_s=0.8, lag_rad=-0.75, steering=0.3)


class ContactSearch:
    """Decides whether to search, and by which wave."""

    def __init__(self, robot: Description, *, after_s: float, for_s: float) -> None:
        """after_s: of standing; 0: never."""
        self._standstill = Standstill(after_s)
        self._after_s, self._for_s = after_s, for_s
        self._felt, self._slow = FeltWave(robot), FeltWave(robot, slower=SLOWER)
        apart = spacings(robot)
        wave = replace(TO_HEAD, amplitude_rad=apart * TO_HEAD.amplitude_rad, lag_rad=apart * TO_HEAD.lag_rad)
        self._to_head = HeadSteeredUndulation(robot, wave)
        self._wave: LateralUndulation | None = None  # by which the body moves
        self._from_w: Floats | None = None  # where it was when the last search had ended
        self._since_s = 0.0  # when the search began
        self._led_s, self._left_m = 0.0, math.inf  # when the wave last led nearer to the goal, and how near that was
        self.changed = False  # a wave has begun or ended at this tick

    def decide(self, view: View, middle_w: Floats, *, wanted_m_s: float, near: bool) -> LateralUndulation | None:
        """The wave by which to move at this tick, if any. middle_w: (2,), of the body. near: obstacles are."""
        before = self._wave
        if before is None:
            if self._stands(view, middle_w, abs(wanted_m_s)):
                self._since_s = view.time_s
                self._begin(self._first(middle_w) if near else self._to_head, view)
        elif view.time_s - self._since_s >= self._for_s:
            self.stop()
        elif not self._leads(view, middle_w):
            self._begin(self._felt if before is self._to_head else self._to_head, view)
        self.changed = self._wave is not before
        return self._wave

    def _first(self, middle_w: Floats) -> FeltWave:
        pushed = self._from_w is not None and math.dist(middle_w, self._from_w) > PUSHED_M
        return self._slow if pushed else self._felt

    def _begin(self, wave: LateralUndulation, view: View) -> None:
        self._wave, self._led_s, self._left_m = wave, view.time_s, math.inf
        wave.start_from(np.array(view.joints.angle_rad))

    def _leads(self, view: View, middle_w: Floats) -> bool:
        """Whether the wave has led nearer to the goal of late."""
        if (trajectory := view.trajectory) is None:
            return True
        left_m = math.dist(middle_w, trajectory.goal_w or trajectory.path_w[-1])
        if left_m < self._left_m - LEADS_M:
            self._led_s, self._left_m = view.time_s, left_m
        return view.time_s - self._led_s < LEADS_S

    def _stands(self, view: View, middle_w: Floats, wanted_m_s: float) -> bool:
        if self._from_w is None:
            self._from_w = middle_w
        stands_m = min(STANDS_M, 0.5 * wanted_m_s * self._after_s)
        return self._standstill.seen(view.time_s, view.period_s, middle_w, stands_m)

    def stop(self) -> None:
        """Not before the body has stood for a while again."""
        if self._wave is not None:
            self._from_w = None
        self._wave = None
        self._standstill.forget()

"""Search for contacts: a body at rest without usable push-points moves on by undulation until it has some.

The waves travel along the body from tail to head. On ground whose friction is the same in every direction a body moves
the way that its wave travels (with anisotropic friction, as of wheels or scales, it would be the other way), a few
centimetres a second, and it sweeps as much to the sides. Navigation plans a new path from wherever that leads.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.undulation import HeadSteeredUndulation
from snakesim_hal.arrays import Floats
from snakesim_hal.wire.messages import Description

PERIOD_S = 1.0
LAG_RAD = -0.9  # of a joint behind the one ahead of it: the wave travels to the head


@dataclass(frozen=True)
class Patience:
    """When to search, and for how long."""

    after_s: float  # of standing without a push; 0: never
    for_s: float
    enough_n: float  # of force along the body that contacts allow: nothing is to be searched for


class ContactSearch:
    """Decides whether to search, and makes the waves."""

    def __init__(self, robot: Description, patience: Patience, swing_rad: float) -> None:
        self._patience = patience
        wave = HeadSteeredUndulation.Settings(amplitude_rad=swing_rad, period_s=PERIOD_S, lag_rad=LAG_RAD)
        self._wave = HeadSteeredUndulation(robot, wave)
        self._powerless_since_s: float | None = None
        self._until_s: float | None = None
        self.changed = False  # it has begun or ended at this tick

    @property
    def active(self) -> bool:
        """Whether the body undulates."""
        return self._until_s is not None

    def decide(self, view: View, *, stands: bool, max_force_n: float) -> bool:
        """Whether to undulate at this tick. max_force_n: force along the body that its contacts allow."""
        before, enough = self.active, max_force_n >= self._patience.enough_n
        if self._until_s is not None:
            if enough or view.time_s >= self._until_s:
                self.stop()
        elif enough or not stands:
            self._powerless_since_s = None
        elif self._powerless_since_s is None:
            self._powerless_since_s = view.time_s
        elif 0.0 < self._patience.after_s <= view.time_s - self._powerless_since_s:
            self._until_s = view.time_s + self._patience.for_s
            self._wave.start_from(np.array(view.joints.angle_rad))
        self.changed = self.active != before
        return self.active

    def reference_rad(self, view: View) -> Floats:
        """Angles of all joints."""
        return self._wave.reference_rad(view, view.period_s)

    def stop(self) -> None:
        """Not before the body has stood for a while again."""
        self._until_s = self._powerless_since_s = None

"""Zero, direction and travel of each joint, from how a person moves a robot whose motors are off. Pure.

All angles are joint angles as the present robot file makes them of the drives': (n_joints,) rad, tail to head.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Joint

STILL_RAD = 0.01  # a joint that nobody touches moves less, noise included
TURNED_RAD = 0.15  # about 9 degrees: meant, not a shake
RESTS_RAD = 0.02  # a robot that rests, or that a hand holds still, moves less within `RESTS_S`: 0.04 rad/s
RESTS_S = 0.5
BESIDE = 0.5  # share of it that another joint may move along
MARGIN_RAD = 0.02  # between the end that a hand found and the limit that is written
LEAST_TRAVEL_RAD = 0.2


class NotStillError(Exception):
    """A joint moved while it should lie still."""


def zeros(joints: Sequence[Joint], angles_rad: Floats) -> list[float]:
    """`zero_rad` of every drive, of a robot that lies straight: (n, n_joints) samples. Raises NotStillError."""
    spread = np.ptp(angles_rad, axis=0)
    moved = int(np.argmax(spread))
    if spread[moved] > STILL_RAD:
        raise NotStillError(f"{joints[moved].name} moved by {spread[moved]:.3f} rad")
    return Mounting(joints).drive_angle_rad(np.median(angles_rad, axis=0)).tolist()


@dataclass(frozen=True)
class Turn:
    """Which joint a person turned."""

    joint: int
    by_rad: float
    alone: bool  # no other one turned by half as much


def turned(before_rad: Floats, now_rad: Floats) -> Turn | None:
    """Return the joint that turned most; None while none turned far enough."""
    by_rad = now_rad - before_rad
    most = int(np.argmax(np.abs(by_rad)))
    if abs(by_rad[most]) < TURNED_RAD:
        return None
    others = np.delete(np.abs(by_rad), most)
    return Turn(most, float(by_rad[most]), bool((others < BESIDE * abs(by_rad[most])).all()))


class RestWatch:
    """Whether all joints have moved less than `RESTS_RAD` for `RESTS_S`."""

    def __init__(self) -> None:
        self._since_s: float | None = None  # None: there was no sample yet
        self._lowest_rad: Floats = np.zeros(0)  # since then
        self._highest_rad: Floats = np.zeros(0)

    def rests(self, time_s: float, angle_rad: Floats) -> bool:
        """Take the next sample, and return whether the robot rests.

        Args:
            time_s: of the sample, by the robot's clock.
            angle_rad: joint angles, (n_joints,).
        """
        if self._since_s is None:
            self._begin(time_s, angle_rad)
            return False
        self._lowest_rad = np.minimum(self._lowest_rad, angle_rad)
        self._highest_rad = np.maximum(self._highest_rad, angle_rad)
        if np.max(self._highest_rad - self._lowest_rad) >= RESTS_RAD:
            self._begin(time_s, angle_rad)
            return False
        return time_s - self._since_s >= RESTS_S

    def _begin(self, time_s: float, angle_rad: Floats) -> None:
        self._since_s = time_s
        self._lowest_rad = angle_rad.copy()
        self._highest_rad = angle_rad.copy()


class TurnWatch:
    """One turn by hand, from rest to rest: a turn that is not over yet is not attributed to any joint."""

    def __init__(self) -> None:
        self._watch = RestWatch()
        self._before_rad: Floats | None = None  # at rest; None: the robot still moves

    @property
    def ready(self) -> bool:
        """Whether the robot has come to rest, so that a joint may be turned."""
        return self._before_rad is not None

    def take(self, time_s: float, angle_rad: Floats) -> Turn | None:
        """Take the next sample, and return the turn once the robot rests after it. Arguments as of `RestWatch`."""
        if not self._watch.rests(time_s, angle_rad):
            return None
        if self._before_rad is None:
            self._before_rad = angle_rad.copy()
            return None
        return turned(self._before_rad, angle_rad)


class Travel:
    """The lowest and the highest angle at which each joint has been."""

    def __init__(self, at_rad: Floats) -> None:
        self.lower_rad, self.upper_rad = at_rad.copy(), at_rad.copy()

    def take(self, at_rad: Floats) -> None:
        """One more sample."""
        np.minimum(self.lower_rad, at_rad, out=self.lower_rad)
        np.maximum(self.upper_rad, at_rad, out=self.upper_rad)

    def limits(self, joint: int) -> tuple[float, float] | None:
        """What to write as its limits; None when it was not moved from end to end."""
        least, most = float(self.lower_rad[joint]), float(self.upper_rad[joint])
        if most - least < LEAST_TRAVEL_RAD:
            return None
        return least + MARGIN_RAD, most - MARGIN_RAD

"""Finds zero, turned joint and travel from how a person moves a robot whose motors are off. Pure.

All angles are joint angles, (n_joints,) rad, tail to head, as the present robot file computes them from those of the
drives.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Joint

MAX_UNTOUCHED_RAD = 0.01  # a joint that is not touched moves less, noise included
MIN_TURN_RAD = 0.15  # about 9 degrees; a smaller turn may be a shake of the hand
MAX_REST_RAD = 0.02  # a robot that rests, or that a hand holds still, moves less within `REST_S`: 0.04 rad/s
REST_S = 0.5
MAX_NEIGHBOR_FRACTION = 0.5  # of a turn; if another joint turns further, the turn is not of one joint alone
MARGIN_RAD = 0.02  # between the end that a hand found and the limit that is written
MIN_TRAVEL_RAD = 0.2


class NotStillError(Exception):
    """A joint moved while it should have been still."""


def find_zeros(joints: Sequence[Joint], angles_rad: Floats) -> list[float]:
    """Return `zero_rad` of every drive, from samples of a robot that lies straight.

    Args:
        joints: tail to head.
        angles_rad: samples, (n, n_joints).

    Raises:
        NotStillError: a joint moved.
    """
    range_rad = np.ptp(angles_rad, axis=0)
    max_moved = int(np.argmax(range_rad))
    if range_rad[max_moved] > MAX_UNTOUCHED_RAD:
        raise NotStillError(f"{joints[max_moved].name} moved by {range_rad[max_moved]:.3f} rad")
    return Mounting(joints).to_drive_angle_rad(np.median(angles_rad, axis=0)).tolist()


@dataclass(frozen=True)
class HandTurn:
    """A turn of one joint by a person."""

    joint: int
    by_rad: float
    alone: bool  # no other joint turned by half as much


def find_turned_joint(before_rad: Floats, now_rad: Floats) -> HandTurn | None:
    """Return the turn of the joint that turned most; None if no joint turned far enough."""
    turned_rad = now_rad - before_rad
    joint = int(np.argmax(np.abs(turned_rad)))
    if abs(turned_rad[joint]) < MIN_TURN_RAD:
        return None
    others_rad = np.delete(np.abs(turned_rad), joint)
    alone = bool((others_rad < MAX_NEIGHBOR_FRACTION * abs(turned_rad[joint])).all())
    return HandTurn(joint, float(turned_rad[joint]), alone)


class RestDetector:
    """Detects whether all joints have moved less than `MAX_REST_RAD` for `REST_S`."""

    def __init__(self) -> None:
        self._since_s: float | None = None  # None: there was no sample yet
        self._lowest_rad: Floats = np.zeros(0)  # since then
        self._highest_rad: Floats = np.zeros(0)

    def add_sample(self, time_s: float, angle_rad: Floats) -> bool:
        """Add the next sample, and return whether the robot rests.

        Args:
            time_s: of the sample, by the robot's clock.
            angle_rad: joint angles, (n_joints,).
        """
        if self._since_s is None:
            self._restart(time_s, angle_rad)
            return False
        self._lowest_rad = np.minimum(self._lowest_rad, angle_rad)
        self._highest_rad = np.maximum(self._highest_rad, angle_rad)
        if np.max(self._highest_rad - self._lowest_rad) >= MAX_REST_RAD:
            self._restart(time_s, angle_rad)
            return False
        return time_s - self._since_s >= REST_S

    def _restart(self, time_s: float, angle_rad: Floats) -> None:
        self._since_s = time_s
        self._lowest_rad = angle_rad.copy()
        self._highest_rad = angle_rad.copy()


class TurnDetector:
    """Detects one turn by hand, from rest to rest: a turn that is not over yet is not attributed to any joint."""

    def __init__(self) -> None:
        self._rest = RestDetector()
        self._before_rad: Floats | None = None  # at rest; None: the robot still moves

    @property
    def ready(self) -> bool:
        """Whether the robot has come to rest, so that a joint may be turned."""
        return self._before_rad is not None

    def add_sample(self, time_s: float, angle_rad: Floats) -> HandTurn | None:
        """Add the next sample, and return the turn once the robot rests after it.

        Args:
            time_s: of the sample, by the robot's clock.
            angle_rad: joint angles, (n_joints,).
        """
        if not self._rest.add_sample(time_s, angle_rad):
            return None
        if self._before_rad is None:
            self._before_rad = angle_rad.copy()
            return None
        return find_turned_joint(self._before_rad, angle_rad)


class Travel:
    """The range of angles in which each joint was moved."""

    def __init__(self, angle_rad: Floats) -> None:
        self.lower_rad = angle_rad.copy()
        self.upper_rad = angle_rad.copy()

    def add_sample(self, angle_rad: Floats) -> None:
        """Extend the ranges by one more sample."""
        np.minimum(self.lower_rad, angle_rad, out=self.lower_rad)
        np.maximum(self.upper_rad, angle_rad, out=self.upper_rad)

    def limits_rad(self, joint: int) -> tuple[float, float] | None:
        """Return the limits to write for a joint; None if it was not moved from end to end."""
        lower = float(self.lower_rad[joint])
        upper = float(self.upper_rad[joint])
        if upper - lower < MIN_TRAVEL_RAD:
            return None
        return lower + MARGIN_RAD, upper - MARGIN_RAD

"""Finds zero, turned joint and travel from how a person moves a robot whose motors are off. Pure.

All angles are joint angles, (n_joints,) rad, tail to head, as the present robot file computes them from those of the
drives.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint

STILLNESS_TOLERANCE_RAD = 0.01  # a joint that is not touched moves less, noise included
MIN_TURN_RAD = 0.15  # about 9 degrees; a smaller turn may be a shake of the hand
# A robot that rests, or that a hand holds still, moves less within `REST_S`: 0.04 rad/s.
MAX_REST_MOTION_RAD = 0.02
REST_S = 0.5
# Of a turn; if another joint turns further, the turn is not of one joint alone.
MAX_NEIGHBOR_FRACTION = 0.5
LIMIT_MARGIN_RAD = 0.02  # between the end that a hand found and the limit that is written
MIN_TRAVEL_RAD = 0.2


class RobotMovedError(Exception):
    """A joint moved while it should have been still."""


def compute_zero_offsets_rad(joints: Sequence[Joint], angles_rad: Floats) -> list[float]:
    """Compute the zero offset (`zero_rad`) of every drive from samples of a robot that lies straight.

    Args:
        joints: Joints of the robot, tail to head.
        angles_rad: Joint angles of all samples, (n_samples, n_joints).

    Returns:
        The angle of each drive in the straight pose, in rad, tail to head.

    Raises:
        RobotMovedError: A joint moved while the samples were taken.
    """
    peak_to_peak_rad = np.ptp(angles_rad, axis=0)
    joint_index = int(np.argmax(peak_to_peak_rad))  # the joint that moved most
    if peak_to_peak_rad[joint_index] > STILLNESS_TOLERANCE_RAD:
        raise RobotMovedError(
            f"{joints[joint_index].name} moved by {peak_to_peak_rad[joint_index]:.3f} rad"
        )
    return DriveMounting(joints).to_drive_angle_rad(np.median(angles_rad, axis=0)).tolist()


@dataclass(frozen=True)
class HandTurn:
    """A turn of one joint by a person."""

    joint_index: int
    angle_rad: float
    is_single_joint: bool  # no other joint turned by half as much


def find_hand_turn(before_rad: Floats, after_rad: Floats) -> HandTurn | None:
    """Return the turn of the joint that turned most between two samples; None if no joint turned far enough."""
    turned_rad = after_rad - before_rad
    joint_index = int(np.argmax(np.abs(turned_rad)))
    if abs(turned_rad[joint_index]) < MIN_TURN_RAD:
        return None
    others_rad = np.delete(np.abs(turned_rad), joint_index)
    is_single_joint = bool(
        (others_rad < MAX_NEIGHBOR_FRACTION * abs(turned_rad[joint_index])).all()
    )
    return HandTurn(joint_index, float(turned_rad[joint_index]), is_single_joint)


class RestDetector:
    """Detects whether all joints have moved less than `MAX_REST_MOTION_RAD` for `REST_S`."""

    def __init__(self) -> None:
        self._still_since_s: float | None = None  # None: there was no sample yet
        self._min_rad: Floats = np.zeros(0)  # since then
        self._max_rad: Floats = np.zeros(0)

    def add_sample(self, time_s: float, angle_rad: Floats) -> bool:
        """Add the next sample, and return whether the robot rests.

        Args:
            time_s: Time of the sample by the robot's clock.
            angle_rad: Joint angles, (n_joints,).

        Returns:
            True once all joints have moved less than `MAX_REST_MOTION_RAD` for `REST_S`.
        """
        if self._still_since_s is None:
            self._restart_at(time_s, angle_rad)
            return False
        self._min_rad = np.minimum(self._min_rad, angle_rad)
        self._max_rad = np.maximum(self._max_rad, angle_rad)
        if np.max(self._max_rad - self._min_rad) >= MAX_REST_MOTION_RAD:
            self._restart_at(time_s, angle_rad)
            return False
        return time_s - self._still_since_s >= REST_S

    def _restart_at(self, time_s: float, angle_rad: Floats) -> None:
        self._still_since_s = time_s
        self._min_rad = angle_rad.copy()
        self._max_rad = angle_rad.copy()


class HandTurnDetector:
    """Detects one turn by hand, from rest to rest: a turn that is not over yet is not attributed to any joint."""

    def __init__(self) -> None:
        self._rest_detector = RestDetector()
        self._before_rad: Floats | None = None  # at rest; None while the robot moves

    @property
    def is_ready(self) -> bool:
        """Whether the robot has come to rest, so that a joint may be turned."""
        return self._before_rad is not None

    def add_sample(self, time_s: float, angle_rad: Floats) -> HandTurn | None:
        """Add the next sample, and return the turn once the robot rests after it.

        Args:
            time_s: Time of the sample by the robot's clock.
            angle_rad: Joint angles, (n_joints,).

        Returns:
            The turn; None as long as the robot moves, and if it came to rest without a turn that is large enough.
        """
        if not self._rest_detector.add_sample(time_s, angle_rad):
            return None
        if self._before_rad is None:
            self._before_rad = angle_rad.copy()
            return None
        return find_hand_turn(self._before_rad, angle_rad)


class TravelRange:
    """The range of angles in which each joint was moved."""

    def __init__(self, angle_rad: Floats) -> None:
        self.lower_rad = angle_rad.copy()
        self.upper_rad = angle_rad.copy()

    def add_sample(self, angle_rad: Floats) -> None:
        """Extend the ranges by one more sample."""
        np.minimum(self.lower_rad, angle_rad, out=self.lower_rad)
        np.maximum(self.upper_rad, angle_rad, out=self.upper_rad)

    def compute_limits_rad(self, joint_index: int) -> tuple[float, float] | None:
        """Return the limits to write for a joint; None if it was not moved from end to end."""
        lower = float(self.lower_rad[joint_index])
        upper = float(self.upper_rad[joint_index])
        if upper - lower < MIN_TRAVEL_RAD:
            return None
        return lower + LIMIT_MARGIN_RAD, upper - LIMIT_MARGIN_RAD

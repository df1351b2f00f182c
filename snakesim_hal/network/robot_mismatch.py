"""Checks that a decoded message fits the robot. Pure.

The wire's bounds do not depend on the robot. A joint state of three joints is valid, but not for a snake of thirteen.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.route import is_line
from snakesim_hal.wire.messages import (
    ColourImage,
    Contacts,
    DepthImage,
    Description,
    Imu,
    JointState,
    Message,
    Pose,
    Power,
    Ranges,
    Trajectory,
    World,
)

MAX_PATH_M = 1e5
UNIT_NORM_ERROR = 0.1  # of a rotation; rounding errors are far smaller


def mismatch(message: Message, robot: Description) -> str | None:
    """Why a message does not fit this robot, as a word to count by; None when it fits."""
    joints, links = len(robot.joints), len(robot.links)
    match message:
        case JointState():
            fits = message.is_of(joints)
        case Power():
            volts = (message.voltage_v, message.current_a, message.motor_c, message.board_c, message.leak)
            fits = {len(values) for values in (*volts, message.valid)} == {joints}
        case Imu():
            alike = len(message.link) == len(message.angular_velocity_rad_s) == len(message.acceleration_m_s2)
            fits = alike and max(message.link, default=0) < links
        case Contacts():
            fits = all(contact.link < links for contact in message.contacts)
        case DepthImage() | ColourImage():
            pixels = message.width * message.height
            fits = (
                len(message.depth) == 2 * pixels if isinstance(message, DepthImage) else len(message.rgb) == 3 * pixels
            )
            if not fits or message.link >= links:
                return "wrong_length"
            return _no_rotation(message.orientation_l_wxyz)
        case Ranges():
            return "wrong_length" if message.link >= links else _no_rotation(message.orientation_l_wxyz)
        case World():
            if not all(contact.link < links for contact in message.contacts):
                return "wrong_length"
            return _no_rotation(message.base_orientation_wxyz)
        case Pose():
            return _no_rotation(message.orientation_wxyz)
        case Trajectory():
            return None if _is_path(np.array(message.path_w)) else "no_path"
        case _:
            fits = True
    return None if fits else "wrong_length"


def _is_path(points_w: NDArray[np.float64]) -> bool:
    """Whether it is a usable path; longer ones would exceed the bounds of `control/state`."""
    return (
        is_line(points_w)
        and float(np.hypot(*np.diff(points_w, axis=0).T).sum()) <= MAX_PATH_M
        and bool((np.abs(points_w) <= MAX_PATH_M).all())
    )


def _no_rotation(wxyz: Sequence[float]) -> str | None:
    return None if abs(math.hypot(*wxyz) - 1.0) <= UNIT_NORM_ERROR else "no_rotation"

"""Checks that a decoded message fits the robot. Pure.

The wire's bounds do not depend on the robot. A joint state of three joints is valid, but not for a snake of thirteen.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import WireError
from snakesim_hal.model.route import is_line
from snakesim_hal.wire.messages import (
    ColorImage,
    Contacts,
    DepthImage,
    Description,
    Imu,
    JointState,
    Message,
    MountedSample,
    Pose,
    Power,
    Trajectory,
    World,
)

MAX_PATH_M = 1e5
OF_JOINTS = ("angle_rad", "velocity_rad_s", "torque_nm", "valid", "age_ns")
OF_POWER = ("voltage_v", "current_a", "motor_c", "board_c", "leak", "valid")
OF_IMUS = ("angular_velocity_rad_s", "acceleration_m_s2")
UNIT_NORM_ERROR = 0.1  # of a rotation; rounding errors are far smaller


def mismatch(message: Message, robot: Description) -> WireError | None:
    """Why a message does not fit this robot, with a reason to count by; None when it fits."""
    joints, last_link = len(robot.joints), len(robot.links) - 1
    match message:
        case JointState():
            return None if message.is_of(joints) else _lengths(message, OF_JOINTS, joints, "one a joint")
        case Power():
            return _lengths(message, OF_POWER, joints, "one a joint")
        case Imu():
            wrong = _lengths(message, OF_IMUS, len(message.link), "one for each of Imu.link")
            return wrong or _beyond("Imu.link", max(message.link, default=0), last_link)
        case Contacts():
            return _touching(message, last_link)
        case DepthImage() | ColorImage():
            pixels = message.width * message.height
            if isinstance(message, DepthImage):
                wrong = _lengths(message, ("depth",), 2 * pixels, "two bytes a pixel")
            else:
                wrong = _lengths(message, ("rgb",), 3 * pixels, "three bytes a pixel")
            return wrong or _mounted(message, last_link)
        case MountedSample():
            return _mounted(message, last_link)
        case World():
            turned = message.base_orientation_wxyz
            return _touching(message, last_link) or _no_rotation("World.base_orientation_wxyz", turned)
        case Pose():
            return _no_rotation("Pose.orientation_wxyz", message.orientation_wxyz)
        case Trajectory():
            if _is_path(np.array(message.path_w)):
                return None
            allowed = f"no two neighbors alike, no longer than {MAX_PATH_M:g} m, and no point further off"
            return WireError("no_path", f"Trajectory.path_w of {len(message.path_w)} points is no path: {allowed}")
        case _:
            return None


def _lengths(message: Message, fields: Sequence[str], wanted: int, why: str) -> WireError | None:
    for field in fields:
        if (length := len(getattr(message, field))) != wanted:
            where = f"{type(message).__name__}.{field}"
            return WireError("wrong_length", f"{where} has length {length}, must have {wanted}: {why}")
    return None


def _touching(message: Contacts | World, last_link: int) -> WireError | None:
    furthest = max((contact.link for contact in message.contacts), default=0)
    return _beyond(f"{type(message).__name__}.contacts: link", furthest, last_link)


def _mounted(message: MountedSample, last_link: int) -> WireError | None:
    name = type(message).__name__
    wrong = _beyond(f"{name}.link", message.link, last_link)
    return wrong or _no_rotation(f"{name}.orientation_l_wxyz", message.orientation_l_wxyz)


def _beyond(where: str, link: int, last_link: int) -> WireError | None:
    if link <= last_link:
        return None
    return WireError("wrong_length", f"{where} is {link}, must be 0 (tail) to {last_link} (head)")


def _is_path(points_w: NDArray[np.float64]) -> bool:
    """Whether it is a usable path; longer ones would exceed the bounds of `control/state`."""
    return (
        is_line(points_w)
        and float(np.hypot(*np.diff(points_w, axis=0).T).sum()) <= MAX_PATH_M
        and bool((np.abs(points_w) <= MAX_PATH_M).all())
    )


def _no_rotation(where: str, wxyz: Sequence[float]) -> WireError | None:
    norm = math.hypot(*wxyz)
    if abs(norm - 1.0) <= UNIT_NORM_ERROR:
        return None
    return WireError("no_rotation", f"{where} is {tuple(wxyz)} of norm {norm:g}, must be a rotation, of norm 1")

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

MAX_PATH_M = 1e5  # a longer path exceeds the bounds of `control/state`
JOINT_STATE_LISTS = ("angle_rad", "velocity_rad_s", "torque_nm", "valid", "age_ns")
POWER_LISTS = ("voltage_v", "current_a", "motor_c", "board_c", "leak", "valid")
IMU_LISTS = ("angular_velocity_rad_s", "acceleration_m_s2")
UNIT_NORM_ERROR = 0.1  # of a rotation; rounding errors are far smaller


def find_mismatch(message: Message, robot: Description) -> WireError | None:
    """Check whether the list lengths, link numbers, rotations and path of a message fit a robot.

    Args:
        message: a decoded message of any class; classes without a check always fit.
        robot: the description of the robot.

    Returns:
        The error, or None if the message fits. `WireError.reason` is a short code, such as `wrong_length`.
    """
    joint_count = len(robot.joints)
    last_link = len(robot.links) - 1
    match message:
        case JointState():
            if message.has_joint_count(joint_count):
                return None
            return _check_lengths(message, JOINT_STATE_LISTS, joint_count, "one a joint")
        case Power():
            return _check_lengths(message, POWER_LISTS, joint_count, "one a joint")
        case Imu():
            error = _check_lengths(message, IMU_LISTS, len(message.link), "one for each of Imu.link")
            return error or _check_link("Imu.link", max(message.link, default=0), last_link)
        case Contacts():
            return _check_contacts(message, last_link)
        case DepthImage():
            error = _check_lengths(message, ("depth",), 2 * message.width * message.height, "two bytes a pixel")
            return error or _check_mount(message, last_link)
        case ColorImage():
            error = _check_lengths(message, ("rgb",), 3 * message.width * message.height, "three bytes a pixel")
            return error or _check_mount(message, last_link)
        case MountedSample():
            return _check_mount(message, last_link)
        case World():
            error = _check_contacts(message, last_link)
            return error or _check_rotation("World.base_orientation_wxyz", message.base_orientation_wxyz)
        case Pose():
            return _check_rotation("Pose.orientation_wxyz", message.orientation_wxyz)
        case Trajectory():
            return _check_path(message)
        case _:
            return None


def _check_path(trajectory: Trajectory) -> WireError | None:
    """Return the error of a trajectory whose points are not a usable path."""
    if _is_path(np.array(trajectory.path_w)):
        return None
    allowed = f"no two neighbors alike, no longer than {MAX_PATH_M:g} m, and no point further off"
    return WireError("no_path", f"Trajectory.path_w of {len(trajectory.path_w)} points is no path: {allowed}")


def _check_lengths(message: Message, fields: Sequence[str], expected_length: int, why: str) -> WireError | None:
    """Return the error of the first field that has another length than expected."""
    for field in fields:
        length = len(getattr(message, field))
        if length != expected_length:
            where = f"{type(message).__name__}.{field}"
            return WireError("wrong_length", f"{where} has length {length}, must have {expected_length}: {why}")
    return None


def _check_contacts(message: Contacts | World, last_link: int) -> WireError | None:
    furthest = max((contact.link for contact in message.contacts), default=0)
    return _check_link(f"{type(message).__name__}.contacts: link", furthest, last_link)


def _check_mount(message: MountedSample, last_link: int) -> WireError | None:
    name = type(message).__name__
    wrong = _check_link(f"{name}.link", message.link, last_link)
    return wrong or _check_rotation(f"{name}.orientation_l_wxyz", message.orientation_l_wxyz)


def _check_link(where: str, link: int, last_link: int) -> WireError | None:
    if link <= last_link:
        return None
    return WireError("wrong_length", f"{where} is {link}, must be 0 (tail) to {last_link} (head)")


def _is_path(points_w: NDArray[np.float64]) -> bool:
    """Return whether points of shape (n, 2) are a usable path."""
    return (
        is_line(points_w)
        and float(np.hypot(*np.diff(points_w, axis=0).T).sum()) <= MAX_PATH_M
        and bool((np.abs(points_w) <= MAX_PATH_M).all())
    )


def _check_rotation(where: str, wxyz: Sequence[float]) -> WireError | None:
    norm = math.hypot(*wxyz)
    if abs(norm - 1.0) <= UNIT_NORM_ERROR:
        return None
    return WireError("no_rotation", f"{where} is {tuple(wxyz)} of norm {norm:g}, must be a rotation, of norm 1")

"""Checks that a decoded message fits the robot. Pure.

The wire's bounds do not depend on the robot. A joint state of three joints is valid, but not for a snake of thirteen.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import WireError
from snakesim_hal.model.geometry.route import is_polyline
from snakesim_hal.wire.messages import (
    ColorImage,
    Contacts,
    DepthImage,
    Imu,
    JointState,
    Message,
    MountedSample,
    Pose,
    Power,
    RobotDescription,
    Trajectory,
    WorldModel,
)

MAX_PATH_M = 1e5  # a longer path exceeds the bounds of `control/state`
JOINT_STATE_LIST_FIELDS = ("angle_rad", "velocity_rad_s", "torque_nm", "valid", "age_ns")
POWER_LIST_FIELDS = ("voltage_v", "current_a", "motor_c", "board_c", "leak", "valid")
IMU_LIST_FIELDS = ("angular_velocity_rad_s", "acceleration_m_s2")
MAX_NORM_ERROR = 0.1  # of a rotation; rounding errors are far smaller

Check = Callable[[Any, RobotDescription], WireError | None]


def find_mismatch(message: Message, robot: RobotDescription) -> WireError | None:
    """Check whether the list lengths, link numbers, rotations and path of a message fit a robot.

    Args:
        message: Decoded message of any class. Classes without a check always fit.
        robot: Description of the robot.

    Returns:
        The error, or None if the message fits. `WireError.reason` is a short code, such as `wrong_length`.
    """
    check = _find_check(type(message))
    if check is None:
        return None
    return check(message, robot)


@cache
def _find_check(message_type: type[Message]) -> Check | None:
    """Return the check for a class of messages; None if it has none. A mounted sensor's class may be a custom one."""
    return next((check for kind, check in CHECKS.items() if issubclass(message_type, kind)), None)


def _check_joint_state(state: JointState, robot: RobotDescription) -> WireError | None:
    joint_count = len(robot.joints)
    if state.has_joint_count(joint_count):
        return None
    return _find_wrong_length(state, JOINT_STATE_LIST_FIELDS, joint_count, "one a joint")


def _check_power(power: Power, robot: RobotDescription) -> WireError | None:
    return _find_wrong_length(power, POWER_LIST_FIELDS, len(robot.joints), "one a joint")


def _check_imu(imu: Imu, robot: RobotDescription) -> WireError | None:
    error = _find_wrong_length(imu, IMU_LIST_FIELDS, len(imu.link), "one for each of Imu.link")
    return error or _find_wrong_link("Imu.link", max(imu.link, default=0), robot)


def _check_depth_image(image: DepthImage, robot: RobotDescription) -> WireError | None:
    error = _find_wrong_length(
        image, ("depth",), 2 * image.width * image.height, "two bytes a pixel"
    )
    return error or _check_mount(image, robot)


def _check_color_image(image: ColorImage, robot: RobotDescription) -> WireError | None:
    error = _find_wrong_length(
        image, ("rgb",), 3 * image.width * image.height, "three bytes a pixel"
    )
    return error or _check_mount(image, robot)


def _check_world(world: WorldModel, robot: RobotDescription) -> WireError | None:
    error = _check_contacts(world, robot)
    return error or _find_wrong_rotation("World.base_orientation_wxyz", world.base_orientation_wxyz)


def _check_pose(pose: Pose, _robot: RobotDescription) -> WireError | None:
    return _find_wrong_rotation("Pose.orientation_wxyz", pose.orientation_wxyz)


class _TrajectoryChecker:
    """Checks trajectories, and remembers the result for the newest one.

    Within one process, all readers of a message get the same object, and each of them checks it. A path has up to 20000
    points, so that repeated checks would take a noticeable part of a tick.
    """

    def __init__(self) -> None:
        # One tuple, because several threads may check at the same time.
        self._newest: tuple[Trajectory | None, WireError | None] = (None, None)

    def check(self, trajectory: Trajectory, _robot: RobotDescription) -> WireError | None:
        """Return the error of a trajectory whose points are not a usable path; None for a usable path."""
        checked, error = self._newest
        if trajectory is not checked:
            error = _check_trajectory(trajectory)
            self._newest = (trajectory, error)
        return error


def _check_trajectory(trajectory: Trajectory) -> WireError | None:
    """Return the error of a trajectory whose points are not a usable path."""
    path_w = trajectory.path_w
    # A path has up to 20000 points. Reading their coordinates one by one takes half the time of `np.array(path_w)`.
    coordinates = np.fromiter(chain.from_iterable(path_w), np.float64, count=2 * len(path_w))
    if _is_path(coordinates.reshape(-1, 2)):
        return None
    allowed = f"no two neighbors alike, no longer than {MAX_PATH_M:g} m, and no point further off"
    return WireError(
        "no_path", f"Trajectory.path_w of {len(trajectory.path_w)} points is no path: {allowed}"
    )


def _find_wrong_length(
    message: Message, fields: Sequence[str], expected_length: int, explanation: str
) -> WireError | None:
    """Return the error of the first field that has another length than expected."""
    for field in fields:
        length = len(getattr(message, field))
        if length != expected_length:
            label = f"{type(message).__name__}.{field}"
            return WireError(
                "wrong_length",
                f"{label} has length {length}, must have {expected_length}: {explanation}",
            )
    return None


def _check_contacts(message: Contacts | WorldModel, robot: RobotDescription) -> WireError | None:
    max_link = max((contact.link for contact in message.contacts), default=0)
    return _find_wrong_link(f"{type(message).__name__}.contacts: link", max_link, robot)


def _check_mount(message: MountedSample, robot: RobotDescription) -> WireError | None:
    name = type(message).__name__
    error = _find_wrong_link(f"{name}.link", message.link, robot)
    return error or _find_wrong_rotation(f"{name}.orientation_l_wxyz", message.orientation_l_wxyz)


def _find_wrong_link(label: str, link_index: int, robot: RobotDescription) -> WireError | None:
    """Return the error of a link number that the robot does not have; None for an existing link."""
    last_link = len(robot.links) - 1
    if link_index <= last_link:
        return None
    return WireError(
        "wrong_length", f"{label} is {link_index}, must be 0 (tail) to {last_link} (head)"
    )


def _is_path(points_w: NDArray[np.float64]) -> bool:
    """Return whether points of shape (n, 2) are a usable path."""
    return (
        is_polyline(points_w)
        and float(np.hypot(*np.diff(points_w, axis=0).T).sum()) <= MAX_PATH_M
        and bool((np.abs(points_w) <= MAX_PATH_M).all())
    )


def _find_wrong_rotation(label: str, wxyz: Sequence[float]) -> WireError | None:
    """Return the error of a quaternion whose norm is not 1; None for a rotation."""
    norm = math.hypot(*wxyz)
    if abs(norm - 1.0) <= MAX_NORM_ERROR:
        return None
    return WireError(
        "no_rotation", f"{label} is {tuple(wxyz)} of norm {norm:g}, must be a rotation, of norm 1"
    )


# The first class that a message belongs to has its check.
CHECKS: dict[type[Message], Check] = {
    JointState: _check_joint_state,
    Power: _check_power,
    Imu: _check_imu,
    Contacts: _check_contacts,
    DepthImage: _check_depth_image,
    ColorImage: _check_color_image,
    MountedSample: _check_mount,
    WorldModel: _check_world,
    Pose: _check_pose,
    Trajectory: _TrajectoryChecker().check,
}

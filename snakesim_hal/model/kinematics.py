"""Forward kinematics: poses of all links from base pose and joint angles. Pure; shared by both sides of the HAL.

Link i's frame has its origin at the joint at its rear and x along the link; link 0's origin is the tail end, and its
frame is the base. A yaw joint turns about z of its link, a pitch joint about y.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import Vector


def rotation_from_quaternion(wxyz: ArrayLike) -> Floats:
    """Rotation matrix (3, 3) of a unit quaternion."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64) / np.linalg.norm(np.asarray(wxyz, dtype=np.float64))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_yaw(yaw_rad: float) -> tuple[float, float, float, float]:
    """Quaternion wxyz of a turn about the world's z."""
    return (float(np.cos(yaw_rad / 2)), 0.0, 0.0, float(np.sin(yaw_rad / 2)))


def quaternions_from_rotations(rotations: Floats) -> Floats:
    """Unit quaternions wxyz (n, 4) of rotation matrices (n, 3, 3)."""
    r = rotations
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    squares = np.stack([trace, *(2 * r[:, i, i] - trace for i in range(3))], axis=1)  # 4 q² - 1 of w, x, y, z
    w, x, y, z = np.sqrt(np.maximum(1 + squares, 0)).T / 2
    signed = np.stack([w, x, y, z], axis=1)
    a, b, c = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]  # 4 w x, 4 w y, 4 w z
    d, e, f = r[:, 1, 0] + r[:, 0, 1], r[:, 0, 2] + r[:, 2, 0], r[:, 2, 1] + r[:, 1, 2]  # 4 x y, 4 x z, 4 y z
    products = [(4 * w * w, a, b, c), (a, 4 * x * x, d, e), (b, d, 4 * y * y, f), (c, e, f, 4 * z * z)]
    by_maximum = np.stack([np.stack(row, axis=1) for row in products], axis=1)  # row i: 4 q_i q
    found = by_maximum[np.arange(len(r)), np.argmax(signed, axis=1)]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def yaw_of(rotation: Floats) -> float:
    """Heading of a frame's x axis on the ground."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def joint_rotation(axis: str, angle_rad: float) -> Floats:
    """Rotation (3, 3) of one joint about its own axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    if axis == "yaw":
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def link_frames(
    base_position_w: ArrayLike,
    base_rotation: Floats,
    angles_rad: Sequence[float] | Floats,
    axes: Sequence[str],
    link_lengths_m: Sequence[float],
) -> tuple[Floats, Floats]:
    """Origins (n_links, 3) and rotations world_from_link (n_links, 3, 3), tail to head."""
    count = len(axes) + 1
    if "pitch" not in axes:
        return _yaw_only_frames(np.asarray(base_position_w), base_rotation, np.asarray(angles_rad), link_lengths_m)
    origins = np.empty((count, 3))
    rotations = np.empty((count, 3, 3))
    origins[0] = base_position_w
    rotations[0] = base_rotation
    for i, axis in enumerate(axes):
        origins[i + 1] = origins[i] + rotations[i][:, 0] * link_lengths_m[i]
        rotations[i + 1] = rotations[i] @ joint_rotation(axis, float(angles_rad[i]))
    return origins, rotations


def nodes_w(robot: Description, position_w: ArrayLike, wxyz: ArrayLike, angles_rad: Sequence[float] | Floats) -> Floats:
    """Tail end, joints and head end in the world, (joints + 2, 3), of one pose."""
    lengths_m = [link.length_m for link in robot.links]
    axes = [joint.axis for joint in robot.joints]
    origins, rotations = link_frames(position_w, rotation_from_quaternion(wxyz), angles_rad, axes, lengths_m)
    return np.vstack([origins, origins[-1] + lengths_m[-1] * rotations[-1][:, 0]])


def _yaw_only_frames(
    base_w: Floats, base_rotation: Floats, angles_rad: Floats, link_lengths_m: Sequence[float]
) -> tuple[Floats, Floats]:
    """All joints turn about the same axis, so angles add up; the loop over links becomes a sum."""
    turn = np.concatenate(([0.0], np.cumsum(angles_rad)))
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y, z = base_rotation.T
    forward = c * x + s * y
    rotations = np.stack([forward, c * y - s * x, np.broadcast_to(z, forward.shape)], axis=2)
    origins = np.empty_like(forward)
    origins[0] = base_w
    origins[1:] = base_w + np.cumsum(forward[:-1] * np.asarray(link_lengths_m)[:-1, None], axis=0)
    return origins, rotations


def tangents(normal: Vector) -> tuple[Vector, Vector]:
    """Two unit tangents of a contact: the one closest to the link's x axis, and the cross product of normal and it."""
    x, y, z = normal
    across = math.sqrt(max(1.0 - x * x, 0.0))
    if across < 1e-6:
        return (0.0, 1.0, 0.0), (0.0, 0.0, math.copysign(1.0, x))
    return (across, -x * y / across, -x * z / across), (0.0, z / across, -y / across)

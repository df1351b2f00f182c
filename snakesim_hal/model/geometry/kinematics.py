"""Forward kinematics: poses of all links from base pose and joint angles. Pure; shared by both sides of the HAL.

Link i's frame has its origin at the joint at its rear and x along the link; link 0's origin is the tail end, and its
frame is the base. A yaw joint rotates about z of its link, a pitch joint about y.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import Vector


def rotation_from_quaternion(wxyz: ArrayLike) -> Floats:
    """Return the rotation matrix (3, 3) of a quaternion, which is normalized first."""
    quaternion = np.asarray(wxyz, dtype=np.float64)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_yaw(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return the quaternion wxyz of a rotation about the world's z axis."""
    half_rad = yaw_rad / 2
    return (float(np.cos(half_rad)), 0.0, 0.0, float(np.sin(half_rad)))


def quaternion_from_rotation(rotation: Floats) -> tuple[float, float, float, float]:
    """Return the unit quaternion wxyz of a rotation matrix (3, 3)."""
    w, x, y, z = quaternions_from_rotations(rotation[None])[0].tolist()
    return (w, x, y, z)


def quaternions_from_rotations(rotations: Floats) -> Floats:
    """Convert rotation matrices (n, 3, 3) to unit quaternions wxyz (n, 4).

    The elements of a rotation matrix give all products 4 q_i q_j of two quaternion components. Every row of the
    matrix of these products is a multiple of the quaternion. The row with the largest diagonal element is the most
    precise one, so it is taken and normalized.
    """
    m = np.moveaxis(rotations, 0, -1)  # (3, 3, n)
    four_wx = m[2, 1] - m[1, 2]
    four_wy = m[0, 2] - m[2, 0]
    four_wz = m[1, 0] - m[0, 1]
    four_xy = m[1, 0] + m[0, 1]
    four_xz = m[0, 2] + m[2, 0]
    four_yz = m[2, 1] + m[1, 2]
    four_products = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], four_wx, four_wy, four_wz],
            [four_wx, 1 + m[0, 0] - m[1, 1] - m[2, 2], four_xy, four_xz],
            [four_wy, four_xy, 1 - m[0, 0] + m[1, 1] - m[2, 2], four_yz],
            [four_wz, four_xz, four_yz, 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )  # (4, 4, n)
    largest = np.argmax(np.diagonal(four_products), axis=1)  # (n,)
    multiples = four_products[largest, :, np.arange(len(rotations))]  # (n, 4)
    return multiples / np.linalg.norm(multiples, axis=1, keepdims=True)


def yaw_from_rotation(rotation: Floats) -> float:
    """Return the heading of a frame's x axis on the ground, in rad."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def compute_joint_rotation(axis: str, angle_rad: float) -> Floats:
    """Return the rotation (3, 3) of one joint about its own axis."""
    cosine = np.cos(angle_rad)
    sine = np.sin(angle_rad)
    if axis == "yaw":
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def compute_link_frames(
    base_position_w: ArrayLike,
    base_rotation: Floats,
    angles_rad: Sequence[float] | Floats,
    axes: Sequence[str],
    link_lengths_m: Sequence[float],
) -> tuple[Floats, Floats]:
    """Compute the frames of all links in the world, tail to head (forward kinematics).

    Args:
        base_position_w: Position of the tail end, (3,), m.
        base_rotation: Rotation matrix world_from_base, (3, 3).
        angles_rad: Joint angles, (n_joints,), tail to head.
        axes: Axis of every joint, "yaw" or "pitch", tail to head.
        link_lengths_m: Length of every link, tail to head. There is one link more than joints.

    Returns:
        Origins of the links, (n_links, 3) in m, and their rotation matrices world_from_link, (n_links, 3, 3).
    """
    if "pitch" not in axes:
        return _compute_planar_link_frames(
            np.asarray(base_position_w), base_rotation, np.asarray(angles_rad), link_lengths_m
        )
    link_count = len(axes) + 1
    origins = np.empty((link_count, 3))
    rotations = np.empty((link_count, 3, 3))
    origins[0] = base_position_w
    rotations[0] = base_rotation
    for i, axis in enumerate(axes):
        origins[i + 1] = origins[i] + rotations[i][:, 0] * link_lengths_m[i]
        rotations[i + 1] = rotations[i] @ compute_joint_rotation(axis, float(angles_rad[i]))
    return origins, rotations


def compute_body_points_w(
    robot: RobotDescription,
    position_w: ArrayLike,
    wxyz: ArrayLike,
    angles_rad: Sequence[float] | Floats,
) -> Floats:
    """Compute tail end, joints and head end of one pose in the world, (n_joints + 2, 3) in m.

    Args:
        robot: Description of the robot, with the lengths of the links and the axes of the joints.
        position_w: Position of the tail end, (3,), m.
        wxyz: Orientation of the base as a quaternion, (4,).
        angles_rad: Joint angles, (n_joints,), tail to head.
    """
    lengths_m = [link.length_m for link in robot.links]
    axes = [joint.axis for joint in robot.joints]
    origins, rotations = compute_link_frames(
        position_w, rotation_from_quaternion(wxyz), angles_rad, axes, lengths_m
    )
    head_end_w = origins[-1] + lengths_m[-1] * rotations[-1][:, 0]
    return np.vstack([origins, head_end_w])


class ForwardKinematics:
    """Computes the body points of many poses at once, for robots with equal links.

    The results are equal to those of the function `compute_body_points_w` to the last bit.
    """

    def __init__(self, robot: RobotDescription) -> None:
        """Read the lengths of the links and the axes of the joints."""
        self._lengths_m = np.array([link.length_m for link in robot.links])
        self._axes = [joint.axis for joint in robot.joints]
        # Of each joint: its number, and the coordinates (0 for x) that it rotates, the first one towards the second.
        self._joint_indices = np.arange(len(self._axes))
        self._first = np.array([0 if axis == "yaw" else 2 for axis in self._axes], dtype=np.intp)
        self._second = np.array([1 if axis == "yaw" else 0 for axis in self._axes], dtype=np.intp)

    def compute_body_points_w(
        self, positions_w: Floats, wxyz: Floats, angles_rad: Floats
    ) -> Floats:
        """Compute tail end, joints and head end of every pose in the world, (n, n_joints + 2, 3) in m.

        Args:
            positions_w: Positions of the tail ends, (n, 3), m.
            wxyz: Orientations of the bases as quaternions, (n, 4).
            angles_rad: Joint angles, (n, n_joints), tail to head.
        """
        lengths_m = self._lengths_m
        rotations = _rotations_from_quaternions(wxyz)
        body_points_w = np.empty((len(positions_w), len(self._axes) + 2, 3))
        body_points_w[:, 0] = positions_w
        if "pitch" not in self._axes:
            forward = self._compute_planar_link_axes(rotations, angles_rad)
            link_vectors = forward[:, :-1] * lengths_m[:-1, None]
            body_points_w[:, 1:-1] = positions_w[:, None] + link_vectors.cumsum(axis=1)
            body_points_w[:, -1] = body_points_w[:, -2] + lengths_m[-1] * forward[:, -1]
            return body_points_w
        forward = self._compute_link_axes(rotations, angles_rad)
        body_points_w[:, 1:] = forward * lengths_m[:, None]
        # A cumulative sum adds one link after the other, as a loop would.
        return body_points_w.cumsum(axis=1)

    def _compute_link_axes(self, base_rotations: Floats, angles_rad: Floats) -> Floats:
        """Return the x axes of all links, (n, n_links, 3), of robots with any joints."""
        joint_rotations = self._compute_joint_rotations(angles_rad)
        rotations = np.empty((len(self._axes) + 1, *base_rotations.shape))
        rotations[0] = base_rotations
        if len(angles_rad) == 1:
            # For a single pose `dot` gives the same bits as `matmul`, in half of the time.
            for i, joint_rotation in enumerate(joint_rotations[:, 0]):
                rotations[i, 0].dot(joint_rotation, rotations[i + 1, 0])
        else:
            for i, joint_rotation in enumerate(joint_rotations):
                np.matmul(rotations[i], joint_rotation, out=rotations[i + 1])
        return rotations[:, :, :, 0].swapaxes(0, 1)

    def _compute_joint_rotations(self, angles_rad: Floats) -> Floats:
        """Return the rotations of all joints at many angles about their own axes, (n_joints, n, 3, 3).

        All joints are computed at once: NumPy's calls would take longer than the arithmetic of a single joint.
        """
        rotations = np.zeros((len(self._axes), len(angles_rad), 3, 3))
        rotations[:, :, [0, 1, 2], [0, 1, 2]] = 1.0  # what a joint does not rotate
        joints = self._joint_indices
        first = self._first
        second = self._second
        cosine = np.cos(angles_rad.T)
        sine = np.sin(angles_rad.T)
        rotations[joints, :, first, first] = cosine
        rotations[joints, :, first, second] = -sine
        rotations[joints, :, second, first] = sine
        rotations[joints, :, second, second] = cosine
        return rotations

    def _compute_planar_link_axes(self, rotations: Floats, angles_rad: Floats) -> Floats:
        """Return the x axes of all links, (n, n_links, 3), of robots whose joints all yaw."""
        # Of each link, relative to the base.
        yaw_rad = np.zeros((len(angles_rad), len(self._axes) + 1))
        angles_rad.cumsum(axis=1, out=yaw_rad[:, 1:])
        cosine = np.cos(yaw_rad)[:, :, None]
        sine = np.sin(yaw_rad)[:, :, None]
        return cosine * rotations[:, None, :, 0] + sine * rotations[:, None, :, 1]


# Each element of a rotation matrix, row by row, is twice a sum of two products of components of the quaternion.
# On the diagonal that is subtracted from 1.
# Index 4 i + j of the product of components i and j.
FIRST_PRODUCT_INDEX = np.array([10, 6, 7, 6, 5, 11, 7, 11, 5])
SECOND_PRODUCT_INDEX = np.array([15, 3, 2, 3, 15, 1, 2, 1, 10])
SECOND_SIGN = np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
DIAGONAL = slice(0, 9, 4)


def _rotations_from_quaternions(wxyz: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of quaternions (n, 4), which are normalized first."""
    unit = wxyz / np.sqrt(np.vecdot(wxyz, wxyz))[:, None]
    products = (unit[:, :, None] * unit[:, None, :]).reshape(-1, 16)
    elements = 2 * (
        products.take(FIRST_PRODUCT_INDEX, axis=1)
        + SECOND_SIGN * products.take(SECOND_PRODUCT_INDEX, axis=1)
    )
    elements[:, DIAGONAL] = 1 - elements[:, DIAGONAL]
    return elements.reshape(-1, 3, 3)


def _compute_planar_link_frames(
    base_w: Floats, base_rotation: Floats, angles_rad: Floats, link_lengths_m: Sequence[float]
) -> tuple[Floats, Floats]:
    """Compute the frames of all links of a chain whose joints all rotate about the base's vertical axis.

    The angles of such joints add up, so that no loop over the links is needed.

    Args:
        base_w: Position of the tail end, (3,), m.
        base_rotation: Rotation matrix world_from_base, (3, 3).
        angles_rad: Joint angles, (n_joints,), tail to head.
        link_lengths_m: Length of every link, tail to head. There is one link more than joints.

    Returns:
        Origins of the links, (n_links, 3) in m, and their rotation matrices world_from_link, (n_links, 3, 3).
    """
    yaw_rad = np.concatenate(([0.0], np.cumsum(angles_rad)))  # of each link, relative to the base
    cosine = np.cos(yaw_rad)[:, None]
    sine = np.sin(yaw_rad)[:, None]
    base_x, base_y, base_z = base_rotation.T
    forward = cosine * base_x + sine * base_y
    left = cosine * base_y - sine * base_x
    rotations = np.empty((len(forward), 3, 3))
    rotations[:, :, 0] = forward
    rotations[:, :, 1] = left
    rotations[:, :, 2] = base_z

    link_vectors = forward[:-1] * np.asarray(link_lengths_m)[:-1, None]
    origins = np.empty_like(forward)
    origins[0] = base_w
    origins[1:] = base_w + np.cumsum(link_vectors, axis=0)
    return origins, rotations


def compute_contact_tangents(normal: Vector) -> tuple[Vector, Vector]:
    """Compute two unit tangents of a contact, in the link's frame.

    The first is the tangent that is closest to the link's x axis, and the second is the cross product of the normal
    and the first. If the normal is along x, the y axis is the first.
    """
    x, y, z = normal
    across = math.sqrt(max(1.0 - x * x, 0.0))
    if across < 1e-6:
        return (0.0, 1.0, 0.0), (0.0, 0.0, math.copysign(1.0, x))
    along_link = (across, -x * y / across, -x * z / across)
    around_link = (0.0, z / across, -y / across)
    return along_link, around_link

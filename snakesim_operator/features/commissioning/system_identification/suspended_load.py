"""The torques that the links of a robot suspended by its tail need, for their inertia and their weight. Pure.

Newton's and Euler's equations from link to link, for all ticks at once. The tail link is clamped with its x axis
pointing down, so its rotation about x does not matter.

Source: Luh, Walker and Paul (1980), "On-line computational scheme for mechanical manipulators".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.links import Link
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2

UNIT_VECTOR_BY_AXIS = {"yaw": (0.0, 0.0, 1.0), "pitch": (0.0, 1.0, 0.0)}


@dataclass(frozen=True)
class _LinkMotion:
    """The motion of a link in its own frame, (n, 3) each."""

    omega: Floats  # angular velocity, rad/s
    alpha: Floats  # angular acceleration, rad/s^2
    # Of the link's rear joint, m/s^2; weight counts as an acceleration upwards.
    acceleration: Floats


def list_links(robot: RobotFile) -> Sequence[Link]:
    """Return every link, tail to head, also of a robot whose file lists none."""
    if robot.links:
        return robot.links
    pairs = zip(robot.link_lengths_m, robot.link_masses_kg, strict=True)
    return [Link(length_m=length, mass_kg=mass) for length, mass in pairs]


def compute_link_loads_nm(
    robot: RobotFile, angle_rad: Floats, velocity_rad_s: Floats, acceleration_rad_s2: Floats
) -> Floats:
    """Return the torque that the links need at every joint, (n, joints); the rotors' inertia is not included.

    All arguments are (n, joints), tail to head.
    """
    links = list_links(robot)
    rotations = [
        make_rotations_about(np.array(UNIT_VECTOR_BY_AXIS[axis]), angle_rad[:, joint])
        for joint, axis in enumerate(robot.axes)
    ]  # of each joint, from the frame of the link ahead to that of the link behind
    motions = _propagate_link_motions(robot, links, rotations, velocity_rad_s, acceleration_rad_s2)
    return _compute_joint_torques_nm(robot, links, rotations, motions)


def _propagate_link_motions(
    robot: RobotFile,
    links: Sequence[Link],
    rotations: Sequence[Floats],
    velocity_rad_s: Floats,
    acceleration_rad_s2: Floats,
) -> list[_LinkMotion]:
    """Compute the motion of the link ahead of each joint, from the tail to the head (forward Newton-Euler recursion).

    With l to the link's front joint, R of the joint, z its axis and q its angle:

        a'     = R' (a + alpha x l + omega x (omega x l))
        alpha' = R' alpha + (R' omega) x (q' z) + q'' z
        omega' = R' omega + q' z

    Args:
        robot: The robot, which is suspended by its tail link; the tail link does not move.
        links: Lengths and masses of all links, tail to head.
        rotations: For each joint, (n, 3, 3) from the link ahead to the link behind.
        velocity_rad_s: (n, joints) joint velocities q'.
        acceleration_rad_s2: (n, joints) joint accelerations q''.

    Returns:
        For each joint, the angular velocity, the angular acceleration and the acceleration of the link ahead of it, (n,
        3) each in the frame of that link; the acceleration includes gravity.
    """
    tick_count = len(velocity_rad_s)
    omega_rad_s = np.zeros((tick_count, 3))
    alpha_rad_s2 = np.zeros((tick_count, 3))
    acceleration_m_s2 = np.tile([-GRAVITY_M_S2, 0.0, 0.0], (tick_count, 1))
    motions: list[_LinkMotion] = []
    for joint, axis_name in enumerate(robot.axes):
        axis = np.array(UNIT_VECTOR_BY_AXIS[axis_name])
        # From the rear to the front of the link behind the joint.
        to_front = np.array([links[joint].length_m, 0.0, 0.0])
        acceleration_m_s2 = (
            acceleration_m_s2
            + np.cross(alpha_rad_s2, to_front)
            + np.cross(omega_rad_s, np.cross(omega_rad_s, to_front))
        )
        omega_rad_s = _rotate_into_link_ahead(rotations[joint], omega_rad_s)
        alpha_rad_s2 = _rotate_into_link_ahead(rotations[joint], alpha_rad_s2)
        acceleration_m_s2 = _rotate_into_link_ahead(rotations[joint], acceleration_m_s2)
        joint_rate = velocity_rad_s[:, joint, None] * axis
        alpha_rad_s2 = (
            alpha_rad_s2
            + np.cross(omega_rad_s, joint_rate)
            + acceleration_rad_s2[:, joint, None] * axis
        )
        omega_rad_s = omega_rad_s + joint_rate
        motions.append(_LinkMotion(omega_rad_s, alpha_rad_s2, acceleration_m_s2))
    return motions


def _compute_joint_torques_nm(
    robot: RobotFile,
    links: Sequence[Link],
    rotations: Sequence[Floats],
    motions: Sequence[_LinkMotion],
) -> Floats:
    """Compute the torque through every joint, from the head to the tail (backward Newton-Euler recursion).

    With c to the center of mass, l to the front joint, I the inertia about c, and f and m from the link ahead:

        F  = mass (a + alpha x c + omega x (omega x c))
        m' = I alpha + omega x (I omega) + c x F + m + l x f
        f' = F + f

    Args:
        robot: The robot, with the axes of its joints.
        links: Lengths, masses and inertias of all links, tail to head.
        rotations: For each joint, (n, 3, 3) from the link ahead to the link behind.
        motions: Motion of the link ahead of each joint.

    Returns:
        (n, joints) torques in N·m.
    """
    tick_count = len(motions[0].omega)
    torque_nm = np.zeros((tick_count, len(motions)))
    force_n = np.zeros((tick_count, 3))  # of the link ahead on this one, in this link's frame
    moment_nm = np.zeros((tick_count, 3))
    for joint in reversed(range(len(motions))):
        link = links[joint + 1]  # the link ahead of the joint
        motion = motions[joint]
        center = np.array(link.center)
        to_front = np.array([link.length_m, 0.0, 0.0])
        xx, yy, zz, xy, xz, yz = link.inertia(robot.module.radius_m)
        inertia_kg_m2 = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        centripetal = np.cross(motion.omega, np.cross(motion.omega, center))
        inertial_force_n = link.mass_kg * (
            motion.acceleration + np.cross(motion.alpha, center) + centripetal
        )
        inertial_moment_nm = motion.alpha @ inertia_kg_m2 + np.cross(
            motion.omega, motion.omega @ inertia_kg_m2
        )
        moment_nm = (
            inertial_moment_nm
            + np.cross(center, inertial_force_n)
            + moment_nm
            + np.cross(to_front, force_n)
        )
        force_n = inertial_force_n + force_n
        torque_nm[:, joint] = moment_nm @ np.array(UNIT_VECTOR_BY_AXIS[robot.axes[joint]])
        force_n = _rotate_into_link_behind(rotations[joint], force_n)
        moment_nm = _rotate_into_link_behind(rotations[joint], moment_nm)
    return torque_nm


def _rotate_into_link_ahead(rotation: Floats, vector: Floats) -> Floats:
    return np.einsum("nji,nj->ni", rotation, vector)


def _rotate_into_link_behind(rotation: Floats, vector: Floats) -> Floats:
    return np.einsum("nij,nj->ni", rotation, vector)


def make_rotations_about(axis: Floats, angle_rad: Floats) -> Floats:
    """Return the rotation matrices by angles, (n,), about a unit axis, (n, 3, 3).

    R = 1 + sin(a) K + (1 - cos(a)) K K, where K v = axis x v. Source: Rodrigues' formula.
    """
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin = np.sin(angle_rad)[:, None, None]
    cos = np.cos(angle_rad)[:, None, None]
    return np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)

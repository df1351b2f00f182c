"""The planar dynamics of the chain of links, for the contact estimate. Pure.

All equations have one form, with a row for each of n joints, one for the moment of the whole body about its center of
mass, and two for its forces in the plane: n + 3 rows. Everything is in the frame of the base (suffix _b). The chain has
n + 1 links; x and y are the plane, z is up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import Imu, Pose, RobotDescription

FRICTION_SLIP_SPEED_M_S = 0.01  # a slower link is held by friction as much as it is braked
# Of each link's weight, in each direction: the ground does not carry all links alike.
LOAD_SHARING_SD = 0.06
ACCELERATION_SD_M_S2 = 0.05  # of an accelerometer of the shipped robots
# Standard deviations of accelerations before anything is measured: of the links' turning, and of the tail end.
ANGULAR_ACCELERATION_PRIOR_SD_RAD_S2 = 30.0
TAIL_ACCELERATION_PRIOR_SD_M_S2 = 3.0
# Likewise for a robot without IMUs, which creeps at about 0.1 m/s. With larger ones hardly any push would show.
ANGULAR_ACCELERATION_PRIOR_SD_WITHOUT_IMU_RAD_S2 = 3.0
TAIL_ACCELERATION_PRIOR_SD_WITHOUT_IMU_M_S2 = 0.3

UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class ChainDynamics:
    """The chain as it lies."""

    rear_b: Floats  # (n + 1, 3) rear end of each link: a joint, except for the tail
    frames: Floats  # (n + 1, 3, 3) base_from_link
    axes_b: Floats  # (n, 3) of the yaw joints; zero for others
    lengths_m: Floats  # (n + 1,)
    masses_kg: Floats  # (n + 1,)
    radii_m: Floats  # (n + 1,)
    rotor_inertias_kg_m2: Floats  # (n,) inertia of the yaw joints' rotors; zero for others

    @classmethod
    def from_robot(cls, robot: RobotDescription, angles_rad: Sequence[float]) -> "ChainDynamics":
        """Return the chain at joint angles, (n,) tail to head."""
        axes = [joint.axis for joint in robot.joints]
        lengths = [link.length_m for link in robot.links]
        rear_b, frames = compute_link_frames((0.0, 0.0, 0.0), np.eye(3), angles_rad, axes, lengths)
        is_yaw = np.array([axis == "yaw" for axis in axes])
        return cls(
            rear_b=rear_b,
            frames=frames,
            axes_b=frames[1:, :, 2] * is_yaw[:, None],
            lengths_m=np.array(lengths),
            masses_kg=np.array([link.mass_kg for link in robot.links]),
            radii_m=np.array([link.radius_m for link in robot.links]),
            rotor_inertias_kg_m2=np.array([joint.rotor_kg_m2 for joint in robot.joints]) * is_yaw,
        )

    @property
    def link_vectors_b(self) -> Floats:
        """From the rear to the front end of each link, (n + 1, 3)."""
        return self.frames[:, :, 0] * self.lengths_m[:, None]

    @property
    def middles_b(self) -> Floats:
        """Middle of each link, (n + 1, 3)."""
        return self.rear_b + self.link_vectors_b / 2

    def compute_generalized_forces(
        self, links: NDArray[np.intp], points_b: Floats, forces_b: Floats
    ) -> Floats:
        """Compute the generalized forces of m forces: what each of them contributes to every equation of motion.

        The robot has n joints. A force f at the point r has a moment about the axis of each joint behind its link, with
        the joint at p_i: axis_i . ((r - p_i) x f).

        Args:
            links: (m,) index of the link on which each force acts, from 0 at the tail.
            points_b: (m, 3) points at which the forces act, in the frame of the base, m.
            forces_b: (m, 3) forces in the frame of the base, N.

        Returns:
            (n + 3, m), a column for each force: n moments about the joints and one about the center of mass, in N·m,
            then the force in x and y, in N.
        """
        # Joint i is at the rear end of link i + 1. From each joint to each force: (n, m, 3).
        joints_b = self.rear_b[1:]
        lever_arms_b = points_b[None, :, :] - joints_b[:, None, :]
        moments_b = np.cross(lever_arms_b, forces_b)
        joint_moments_nm = np.einsum("ij,imj->im", self.axes_b, moments_b)  # (n, m)
        # Only the joints behind the link of a force carry its moment: joint i is behind the links from i + 1 on.
        joint_indices = np.arange(len(self.axes_b))
        joint_moments_nm *= joint_indices[:, None] < links

        # About the vertical axis through the center of mass: (m,).
        center_b = self.masses_kg @ self.middles_b / self.masses_kg.sum()
        body_moments_nm = np.cross(points_b - center_b, forces_b)[:, 2]
        return np.vstack([joint_moments_nm, body_moments_nm, forces_b[:, :2].T])


def estimate_angular_velocities(
    chain: ChainDynamics, velocities_rad_s: Sequence[float], imu: Imu
) -> Floats:
    """Estimate the angular velocity of each link about the vertical axis.

    The joint velocities give the differences between links. The mean of the gyroscopes gives the common part, which is
    0 at the tail link without gyroscopes.

    Args:
        chain: Frames and joint axes of the links.
        velocities_rad_s: (n,) joint velocities, tail to head.
        imu: Angular velocities of some links, or of none.

    Returns:
        (n + 1,) angular velocities in rad/s.
    """
    # (n + 1,) of each link relative to the tail link.
    relative_rad_s = np.append(0.0, np.cumsum(chain.axes_b[:, 2] * velocities_rad_s))
    if not imu.link:
        return relative_rad_s
    # Vertical component of each gyroscope's angular velocity, which it measures in the frame of its link.
    measured_rad_s = [
        chain.frames[link][2] @ velocity_l
        for link, velocity_l in zip(imu.link, imu.angular_velocity_rad_s, strict=True)
    ]
    tail_link_rad_s = float(np.mean(np.array(measured_rad_s) - relative_rad_s[imu.link]))
    return relative_rad_s + tail_link_rad_s


def estimate_accelerations(
    chain: ChainDynamics, angular_velocities_rad_s: Floats, imu: Imu
) -> tuple[Floats, Floats]:
    """Estimate the acceleration of the tail end (x, y) and the angular acceleration of each of the n + 1 links.

    n is the number of joints. Linear least squares over all accelerometers, with a prior: the motion of the links is
    coupled by the joints, so that accelerometers correct one another. Without an IMU the result is the prior.

    Args:
        chain: Lengths and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links.
        imu: Specific forces of some links, or of none. Its field `link` is the list of the indices of these links.

    Returns:
        The accelerations (n + 3,), those of the tail end first, and the lower Cholesky factor (n + 3, n + 3) of their
        covariance.
    """
    # Measurement = jacobian @ unknowns + bias. For k sensors it has 2 k rows: x of all sensors, then y of all sensors.
    sensor_count = len(imu.link)
    unknown_count = len(angular_velocities_rad_s) + 2
    model = _make_acceleration_model(chain, angular_velocities_rad_s)
    jacobian_and_bias = model[:, imu.link].reshape(2 * sensor_count, unknown_count + 1)
    jacobian = jacobian_and_bias[:, :-1]
    # Centripetal accelerations of the sensors, without any of the unknown accelerations.
    bias_m_s2 = jacobian_and_bias[:, -1]

    # The measurements, rotated from the frames of their links to that of the base, in the same order: (2 k,).
    specific_forces_l = np.reshape(imu.acceleration_m_s2, (-1, 3))
    specific_forces_b = np.einsum("kij,kj->ki", chain.frames[imu.link], specific_forces_l)
    planar_specific_forces = specific_forces_b[:, :2].T.ravel()

    # The prior: all unknowns are 0, with these standard deviations.
    if sensor_count > 0:
        tail_sd_m_s2 = TAIL_ACCELERATION_PRIOR_SD_M_S2
        angular_sd_rad_s2 = ANGULAR_ACCELERATION_PRIOR_SD_RAD_S2
    else:
        tail_sd_m_s2 = TAIL_ACCELERATION_PRIOR_SD_WITHOUT_IMU_M_S2
        angular_sd_rad_s2 = ANGULAR_ACCELERATION_PRIOR_SD_WITHOUT_IMU_RAD_S2
    prior_sd = np.append(
        np.full(2, tail_sd_m_s2), np.full(len(angular_velocities_rad_s), angular_sd_rad_s2)
    )

    # The least-squares solution, weighted by the inverse variances.
    precision = jacobian.T @ jacobian / ACCELERATION_SD_M_S2**2 + np.diag(prior_sd**-2.0)
    covariance = np.linalg.inv(precision)
    accelerations = (
        covariance @ jacobian.T @ (planar_specific_forces - bias_m_s2) / ACCELERATION_SD_M_S2**2
    )
    return accelerations, np.asarray(np.linalg.cholesky(covariance), np.float64)


def _make_acceleration_model(chain: ChainDynamics, angular_velocities_rad_s: Floats) -> Floats:
    """Return the accelerations of the links' middles as linear functions of the motion.

    With w the spin and l the step of each link, tail to middle:  a = a_tail + sum of (dw/dt z x l - w² l).

    Args:
        chain: Lengths and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links about the vertical axis.

    Returns:
        (2, n + 1, n + 4) coefficients. The first axis is x and y, the second the link. The last axis is the variable:
        acceleration of the tail end in x and y, angular acceleration of each link, and the constant 1.
    """
    link_count = len(angular_velocities_rad_s)
    # Fraction of each link (column) that lies between the tail end and the middle of each link (row).
    vector_fractions = np.tril(np.ones((link_count, link_count)), -1) + np.eye(link_count) / 2
    vector_x = chain.link_vectors_b[:, 0]
    vector_y = chain.link_vectors_b[:, 1]
    model = np.zeros((2, link_count, link_count + 3))
    model[0, :, 0] = 1.0
    model[1, :, 1] = 1.0
    model[0, :, 2:-1] = -vector_fractions * vector_y
    model[1, :, 2:-1] = vector_fractions * vector_x
    model[0, :, -1] = -vector_fractions @ (angular_velocities_rad_s**2 * vector_x)
    model[1, :, -1] = -vector_fractions @ (angular_velocities_rad_s**2 * vector_y)
    return model


def compute_inertia_terms(chain: ChainDynamics, angular_velocities_rad_s: Floats) -> Floats:
    """Compute the inertia terms of all equations of motion, as linear functions of the accelerations.

    Args:
        chain: Lengths, masses and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links about the vertical axis.

    Returns:
        (n + 3, n + 4) coefficients of the right-hand sides without the joint torques. The columns are the variables of
        `_make_acceleration_model`: accelerations of the tail end and the links, and the constant 1.
    """
    link_count = len(angular_velocities_rad_s)
    joint_count = link_count - 1
    links = np.arange(link_count)
    model = _make_acceleration_model(chain, angular_velocities_rad_s)
    inertia = np.zeros((link_count + 2, link_count + 3))

    # Accelerated masses: each link's mass times the acceleration of its middle, in x and in y.
    for axis in (0, 1):
        forces_b = chain.masses_kg[:, None] * np.eye(3)[axis]
        inertia += chain.compute_generalized_forces(links, chain.middles_b, forces_b) @ model[axis]

    # Links that turn: the inertia of a cylinder about an axis across it. A joint carries the links ahead of it.
    link_inertias_kg_m2 = chain.masses_kg * (chain.lengths_m**2 / 12 + chain.radii_m**2 / 4)
    is_ahead_of_joint = np.arange(joint_count)[:, None] < links  # (n, n + 1)
    # Rotors turn with their joint, which is the difference between the link ahead and the link behind: (n, n + 1).
    rotor_terms = chain.rotor_inertias_kg_m2[:, None] * np.diff(np.eye(link_count), axis=0)

    # Columns 2 to n + 2 are the angular accelerations of the links; row n is the moment about the center of mass.
    inertia[:joint_count, 2:-1] += is_ahead_of_joint * link_inertias_kg_m2 + rotor_terms
    inertia[joint_count, 2:-1] += link_inertias_kg_m2
    return inertia


def compute_unit_friction(
    chain: ChainDynamics, angular_velocities_rad_s: Floats, pose: Pose | None
) -> tuple[Floats, Floats]:
    """Compute the generalized force of ground friction with the friction coefficient 1.

    Args:
        chain: Lengths, masses and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links about the vertical axis.
        pose: Velocity of the base; None if the links are assumed to slide forward along themselves.

    Returns:
        The generalized force, (n + 3,), as `compute_generalized_forces` returns it for one force; and a matrix R of
        shape (n + 3, 2 n + 2), with which R R' is the covariance of this force. It is uncertain, because the ground
        does not carry all links alike.
    """
    links = np.arange(len(angular_velocities_rad_s))
    middles_b = chain.middles_b
    slide_directions_b = _compute_slide_directions(chain, angular_velocities_rad_s, pose)
    weights_n = GRAVITY_M_S2 * chain.masses_kg[:, None]
    # The friction of each link is opposite to its motion. Their sum is the friction of the body.
    friction = chain.compute_generalized_forces(
        links, middles_b, -weights_n * slide_directions_b
    ).sum(axis=1)
    # The error of each link's load is a friction force in x and in y, independent of all others.
    friction_by_axis = [
        chain.compute_generalized_forces(links, middles_b, weights_n * axis)
        for axis in np.eye(3)[:2]
    ]
    return friction, LOAD_SHARING_SD * np.hstack(friction_by_axis)


def _compute_slide_directions(
    chain: ChainDynamics, angular_velocities_rad_s: Floats, pose: Pose | None
) -> Floats:
    """Compute the direction in which each link slides over the ground.

    The vectors become shorter at low speeds, because static friction is not known: with the slip speed v_0 of
    FRICTION_SLIP_SPEED_M_S, the direction of a link with the velocity v is v / sqrt(|v|² + v_0²).

    Args:
        chain: Lengths and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links about the vertical axis.
        pose: Velocity of the base; None if the links are assumed to slide forward along themselves.

    Returns:
        (n + 1, 3) vectors in the frame of the base, whose length is nearly 1 for a link that is much faster than the
        slip speed, and 0 for a link that is stationary.
    """
    if pose is None:
        return chain.frames[:, :, 0].copy()
    angular_velocities = angular_velocities_rad_s[:, None]

    # Velocities relative to the tail end, m/s. A link that turns moves its front end relative to its rear end, and the
    # front end of a link is the rear end of the next one: (n + 1, 3) each.
    front_relative_to_rear = np.cross(UP, chain.link_vectors_b) * angular_velocities
    front_end_velocities_b = np.cumsum(front_relative_to_rear, axis=0)
    rear_end_velocities_b = np.vstack([np.zeros(3), front_end_velocities_b[:-1]])
    middle_relative_to_rear = np.cross(UP, chain.middles_b - chain.rear_b) * angular_velocities
    middle_velocities_b = rear_end_velocities_b + middle_relative_to_rear

    # Add the velocity of the tail end, which is the base, and keep what is in the plane of the ground.
    base_velocity_b = rotation_from_quaternion(pose.orientation_wxyz).T @ pose.velocity_w
    middle_velocities_b += base_velocity_b
    middle_velocities_b[:, 2] = 0.0

    speeds_m_s = np.linalg.norm(middle_velocities_b, axis=1)
    return middle_velocities_b / np.hypot(speeds_m_s, FRICTION_SLIP_SPEED_M_S)[:, None]

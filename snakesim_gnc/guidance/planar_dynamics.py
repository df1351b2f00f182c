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
from snakesim_hal.model.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.model.solids import GRAVITY_M_S2
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
        """Compute the generalized forces of m forces: their left-hand sides in all equations of motion.

        A force has a moment about each joint behind its link: axis_i . ((r - p_i) x f).

        Args:
            links: (m,) index of the link on which each force acts.
            points_b: (m, 3) points at which the forces act, in the frame of the base, m.
            forces_b: (m, 3) forces in the frame of the base, N.

        Returns:
            (n + 3, m): moments about the n joints, moment about the center of mass, force in x and y.
        """
        arms = points_b - self.rear_b[1:, None]  # (n, m, 3)
        moments = np.einsum("ij,imj->im", self.axes_b, np.cross(arms, forces_b))
        # Joints ahead of the link carry no moment.
        moments *= np.arange(len(self.axes_b))[:, None] < links
        center_b = self.masses_kg @ self.middles_b / self.masses_kg.sum()
        total_moments = np.cross(points_b - center_b, forces_b)[:, 2]
        return np.vstack([moments, total_moments, forces_b[:, :2].T])


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
    relative_rad_s = np.append(0.0, np.cumsum(chain.axes_b[:, 2] * velocities_rad_s))
    if not imu.link:
        return relative_rad_s
    measured_rad_s = [
        chain.frames[link][2] @ rate
        for link, rate in zip(imu.link, imu.angular_velocity_rad_s, strict=True)
    ]
    return relative_rad_s + float(np.mean(np.array(measured_rad_s) - relative_rad_s[imu.link]))


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
    unknown_count = len(angular_velocities_rad_s) + 2
    jacobian_and_bias = _make_acceleration_model(chain, angular_velocities_rad_s)[
        :, imu.link
    ].reshape(2 * len(imu.link), unknown_count + 1)
    jacobian = jacobian_and_bias[:, :-1]
    # Centripetal accelerations of the sensors, without any of the unknown accelerations.
    bias_m_s2 = jacobian_and_bias[:, -1]
    # Rows are ordered as in the Jacobian: x of all sensors, then y of all sensors.
    specific_forces_l = np.reshape(imu.acceleration_m_s2, (-1, 3))
    planar_specific_forces = np.einsum("kij,kj->ki", chain.frames[imu.link], specific_forces_l)[
        :, :2
    ].T.ravel()
    has_imu = len(imu.link) > 0
    if has_imu:
        tail_sd_m_s2 = TAIL_ACCELERATION_PRIOR_SD_M_S2
        angular_sd_rad_s2 = ANGULAR_ACCELERATION_PRIOR_SD_RAD_S2
    else:
        tail_sd_m_s2 = TAIL_ACCELERATION_PRIOR_SD_WITHOUT_IMU_M_S2
        angular_sd_rad_s2 = ANGULAR_ACCELERATION_PRIOR_SD_WITHOUT_IMU_RAD_S2
    prior_sd = np.append(
        np.full(2, tail_sd_m_s2), np.full(len(angular_velocities_rad_s), angular_sd_rad_s2)
    )
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
    links = np.arange(link_count)
    model = _make_acceleration_model(chain, angular_velocities_rad_s)
    inertia = np.zeros((link_count + 2, link_count + 3))
    for axis in (0, 1):
        forces_b = chain.masses_kg[:, None] * np.eye(3)[axis]
        inertia += chain.compute_generalized_forces(links, chain.middles_b, forces_b) @ model[axis]
    # Across its axis.
    link_inertias_kg_m2 = chain.masses_kg * (chain.lengths_m**2 / 12 + chain.radii_m**2 / 4)
    is_ahead = np.arange(link_count - 1)[:, None] < links
    rotor_terms = chain.rotor_inertias_kg_m2[:, None] * np.diff(np.eye(link_count), axis=0)
    inertia[: link_count - 1, 2:-1] += is_ahead * link_inertias_kg_m2 + rotor_terms
    inertia[link_count - 1, 2:-1] += link_inertias_kg_m2
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
        The left-hand sides of all equations, (n + 3,); and a root (n + 3, 2 n + 2) of their covariance, because the
        ground does not carry all links alike.
    """
    links = np.arange(len(angular_velocities_rad_s))
    middles_b = chain.middles_b
    slide_velocities = _compute_slide_directions(chain, angular_velocities_rad_s, pose)
    weights_n = GRAVITY_M_S2 * chain.masses_kg[:, None]
    friction = chain.compute_generalized_forces(
        links, middles_b, -weights_n * slide_velocities
    ).sum(axis=1)
    friction_by_axis = [
        chain.compute_generalized_forces(links, middles_b, weights_n * axis)
        for axis in np.eye(3)[:2]
    ]
    return friction, LOAD_SHARING_SD * np.hstack(friction_by_axis)


def _compute_slide_directions(
    chain: ChainDynamics, angular_velocities_rad_s: Floats, pose: Pose | None
) -> Floats:
    """Compute the direction in which each link slides over the ground.

    Args:
        chain: Lengths and frames of the links.
        angular_velocities_rad_s: (n + 1,) angular velocities of the links about the vertical axis.
        pose: Velocity of the base; None if the links are assumed to slide forward along themselves.

    Returns:
        (n + 1, 3) vectors in the frame of the base, whose length is 1 for a fast link and below 1 for a slow one.
    """
    if pose is None:
        return chain.frames[:, :, 0].copy()
    angular_velocities = angular_velocities_rad_s[:, None]
    front_end_velocities = np.cumsum(np.cross(UP, chain.link_vectors_b) * angular_velocities, 0)[
        :-1
    ]
    rear_end_velocities = np.vstack([np.zeros(3), front_end_velocities])
    slide_velocities = (
        rear_end_velocities + np.cross(UP, chain.middles_b - chain.rear_b) * angular_velocities
    )
    slide_velocities += rotation_from_quaternion(pose.orientation_wxyz).T @ pose.velocity_w
    slide_velocities[:, 2] = 0.0
    slide_velocities /= np.hypot(np.linalg.norm(slide_velocities, axis=1), FRICTION_SLIP_SPEED_M_S)[
        :, None
    ]
    return slide_velocities

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
from snakesim_hal.model.kinematics import link_frames, rotation_from_quaternion
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import Description, Imu, Pose

SLIP_M_S = 0.01  # a slower link is held by friction as much as it is braked
SHARING_SD = 0.06  # of each link's weight, in each direction: the ground does not carry all links alike
ACCELERATION_SD_M_S2 = 0.05  # of an accelerometer of the shipped robots
# Standard deviations of accelerations before anything is measured: of the links' turning, and of the tail end.
SPIN_PRIOR_RAD_S2 = 30.0
TAIL_PRIOR_M_S2 = 3.0
# Likewise for a robot without IMUs, which creeps at about 0.1 m/s. With larger ones hardly any push would show.
SPIN_PRIOR_WITHOUT_IMU_RAD_S2 = 3.0
TAIL_PRIOR_WITHOUT_IMU_M_S2 = 0.3

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
    rotors_kg_m2: Floats  # (n,) inertia of the yaw joints' rotors; zero for others

    @classmethod
    def from_robot(cls, robot: Description, angles_rad: Sequence[float]) -> "ChainDynamics":
        """Return the chain at joint angles, (n,) tail to head."""
        axes = [joint.axis for joint in robot.joints]
        lengths = [link.length_m for link in robot.links]
        rear_b, frames = link_frames((0.0, 0.0, 0.0), np.eye(3), angles_rad, axes, lengths)
        is_yaw = np.array([axis == "yaw" for axis in axes])
        return cls(
            rear_b=rear_b,
            frames=frames,
            axes_b=frames[1:, :, 2] * is_yaw[:, None],
            lengths_m=np.array(lengths),
            masses_kg=np.array([link.mass_kg for link in robot.links]),
            radii_m=np.array([link.radius_m for link in robot.links]),
            rotors_kg_m2=np.array([joint.rotor_kg_m2 for joint in robot.joints]) * is_yaw,
        )

    @property
    def steps_b(self) -> Floats:
        """From the rear to the front end of each link, (n + 1, 3)."""
        return self.frames[:, :, 0] * self.lengths_m[:, None]

    @property
    def middles_b(self) -> Floats:
        """Middle of each link, (n + 1, 3)."""
        return self.rear_b + self.steps_b / 2

    def compute_effects(self, links: NDArray[np.intp], points_b: Floats, forces_b: Floats) -> Floats:
        """Return the left sides of all equations, (n + 3, m), for m forces.

        A force has a moment about each joint behind its link: axis_i . ((r - p_i) x f).

        Args:
            links: (m,) link on which each force acts.
            points_b: (m, 3) where it acts.
            forces_b: (m, 3).
        """
        arms = points_b - self.rear_b[1:, None]  # (n, m, 3)
        moments = np.einsum("ij,imj->im", self.axes_b, np.cross(arms, forces_b))
        moments *= np.arange(len(self.axes_b))[:, None] < links
        center_b = self.masses_kg @ self.middles_b / self.masses_kg.sum()
        total_moments = np.cross(points_b - center_b, forces_b)[:, 2]
        return np.vstack([moments, total_moments, forces_b[:, :2].T])


def estimate_spins(chain: ChainDynamics, velocities_rad_s: Sequence[float], imu: Imu) -> Floats:
    """Return the angular velocity of each link about z, (n + 1,) in rad/s.

    The joints give the differences between links, the mean of the gyroscopes gives the level.
    """
    relative = np.append(0.0, np.cumsum(chain.axes_b[:, 2] * velocities_rad_s))
    if not imu.link:
        return relative
    measured = [chain.frames[link][2] @ rate for link, rate in zip(imu.link, imu.angular_velocity_rad_s, strict=True)]
    return relative + float(np.mean(np.array(measured) - relative[imu.link]))


def estimate_accelerations(chain: ChainDynamics, spins_rad_s: Floats, imu: Imu) -> tuple[Floats, Floats]:
    """Estimate the acceleration of the tail end (x, y) and the angular acceleration of each of the n + 1 links.

    Linear least squares over all accelerometers, with a prior: the motion of the links is coupled by the joints, so
    that accelerometers correct one another. Without an IMU the result is the prior.

    Args:
        chain: lengths and frames of the links.
        spins_rad_s: (n + 1,) angular velocities of the links.
        imu: specific forces of some links, or of none.

    Returns:
        The motion (n + 3,), and a matrix root (n + 3, n + 3) of its covariance.
    """
    unknowns = len(spins_rad_s) + 2
    model = _acceleration_model(chain, spins_rad_s)[:, imu.link].reshape(2 * len(imu.link), unknowns + 1)
    jacobian = model[:, :-1]
    measured_l = np.reshape(imu.acceleration_m_s2, (-1, 3))
    measured = np.einsum("kij,kj->ki", chain.frames[imu.link], measured_l)[:, :2].T.ravel()
    tail_sd_m_s2 = TAIL_PRIOR_WITHOUT_IMU_M_S2
    spin_sd_rad_s2 = SPIN_PRIOR_WITHOUT_IMU_RAD_S2
    if imu.link:
        tail_sd_m_s2 = TAIL_PRIOR_M_S2
        spin_sd_rad_s2 = SPIN_PRIOR_RAD_S2
    prior_sd = np.append(np.full(2, tail_sd_m_s2), np.full(len(spins_rad_s), spin_sd_rad_s2))
    precision = jacobian.T @ jacobian / ACCELERATION_SD_M_S2**2 + np.diag(prior_sd**-2.0)
    covariance = np.linalg.inv(precision)
    motion = covariance @ jacobian.T @ (measured - model[:, -1]) / ACCELERATION_SD_M_S2**2
    return motion, np.asarray(np.linalg.cholesky(covariance), np.float64)


def _acceleration_model(chain: ChainDynamics, spins_rad_s: Floats) -> Floats:
    """Return the accelerations of the links' middles as linear functions of the motion.

    With w the spin and l the step of each link, tail to middle:  a = a_tail + sum of (dw/dt z x l - w² l).

    Args:
        chain: lengths and frames of the links.
        spins_rad_s: (n + 1,) angular velocities of the links about the vertical axis.

    Returns:
        (2, n + 1, n + 4) coefficients. The first axis is x and y, the second the link. The last axis is the variable:
        acceleration of the tail end in x and y, angular acceleration of each link, and the constant 1.
    """
    count = len(spins_rad_s)
    step_part = np.tril(np.ones((count, count)), -1) + np.eye(count) / 2  # of each link's step, to each link's middle
    step_x = chain.steps_b[:, 0]
    step_y = chain.steps_b[:, 1]
    model = np.zeros((2, count, count + 3))
    model[0, :, 0] = 1.0
    model[1, :, 1] = 1.0
    model[0, :, 2:-1] = -step_part * step_y
    model[1, :, 2:-1] = step_part * step_x
    model[0, :, -1] = -step_part @ (spins_rad_s**2 * step_x)
    model[1, :, -1] = -step_part @ (spins_rad_s**2 * step_y)
    return model


def compute_inertia(chain: ChainDynamics, spins_rad_s: Floats) -> Floats:
    """Return the right sides of all equations without the torques, (n + 3, n + 4), by the motion and 1."""
    count = len(spins_rad_s)
    links = np.arange(count)
    model = _acceleration_model(chain, spins_rad_s)
    inertia = np.zeros((count + 2, count + 3))
    for axis in (0, 1):
        forces_b = chain.masses_kg[:, None] * np.eye(3)[axis]
        inertia += chain.compute_effects(links, chain.middles_b, forces_b) @ model[axis]
    cylinder_kg_m2 = chain.masses_kg * (chain.lengths_m**2 / 12 + chain.radii_m**2 / 4)  # across its axis
    is_ahead = np.arange(count - 1)[:, None] < links
    rotors = chain.rotors_kg_m2[:, None] * np.diff(np.eye(count), axis=0)
    inertia[: count - 1, 2:-1] += is_ahead * cylinder_kg_m2 + rotors
    inertia[count - 1, 2:-1] += cylinder_kg_m2
    return inertia


def compute_friction(chain: ChainDynamics, spins_rad_s: Floats, pose: Pose | None) -> tuple[Floats, Floats]:
    """Return the left sides for friction of the ground with the coefficient 1, (n + 3,).

    Also returns a root (n + 3, 2 n + 2) of the covariance of how the links share it.
    """
    links = np.arange(len(spins_rad_s))
    middles_b = chain.middles_b
    slide = _slide_directions(chain, spins_rad_s, pose)
    weights_n = GRAVITY_M_S2 * chain.masses_kg[:, None]
    friction = chain.compute_effects(links, middles_b, -weights_n * slide).sum(axis=1)
    per_axis = [chain.compute_effects(links, middles_b, weights_n * axis) for axis in np.eye(3)[:2]]
    return friction, SHARING_SD * np.hstack(per_axis)


def _slide_directions(chain: ChainDynamics, spins_rad_s: Floats, pose: Pose | None) -> Floats:
    """Return the direction in which each link slides, (n + 1, 3); its length is below 1 for a slow link.

    Without a pose the links slide forward along themselves.
    """
    if pose is None:
        return chain.frames[:, :, 0].copy()
    spins = spins_rad_s[:, None]
    rear_velocities = np.cumsum(np.cross(UP, chain.steps_b) * spins, 0)[:-1]
    carried = np.vstack([np.zeros(3), rear_velocities])
    slide = carried + np.cross(UP, chain.middles_b - chain.rear_b) * spins
    slide += rotation_from_quaternion(pose.orientation_wxyz).T @ pose.velocity_w
    slide[:, 2] = 0.0
    slide /= np.hypot(np.linalg.norm(slide, axis=1), SLIP_M_S)[:, None]
    return slide

"""Estimates contacts without contact sensors, from joint torques and accelerations. Pure.

For every yaw joint i Newton and Euler hold for the part of the body ahead of it, and for the whole body:

    sum over contacts ahead of (r_c - p_i) x f_c = sum over links ahead of d/dt(angular momentum about p_i) - tau_i
    sum of (r_c - p) x f_c                       = d/dt(angular momentum about the center of mass p)
    sum of f_c                                   = sum of m_k a_k

r_c and f_c are place and force of contact c, p_i and tau_i place and torque of joint i, m_k and a_k mass and
acceleration of link k. IMUs measure specific force, so weight and support cancel in the plane of the body. Without any
IMU the accelerations are assumed to be small.

Each equation has the weight of its errors: errors of accelerations add up from the head backwards and, because of the
equations of the whole body, from the tail forwards as well. So a contact is estimated best from its nearer end.

The unknowns are the friction of the ground along the links' velocities, and pushes at the ends of each link, on either
side: two of them on one link are one push between. The estimate has the fewest that explain the readings. They are
added one after another, none of them negative (`sparse_fit`).

What it cannot resolve: pushes of opposite sign close together, forces along the links except at the head's tip,
contacts from above or below, and pushes below about 1 N. Pitch joints give no equation of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.contacts.planar_dynamics import (
    ChainDynamics,
    compute_inertia_terms,
    compute_unit_friction,
    estimate_accelerations,
    estimate_angular_velocities,
)
from snakesim_gnc.guidance.contacts.sparse_fit import MIN_SIGNIFICANCE_SD, fit_fewest_columns
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Imu, Pose, RobotDescription
from snakesim_hal.wire.quantities import Vector

# Standard deviations of the measurements; of the shipped robots.
TORQUE_SD_NM = 0.012
# Variance of the equations of the whole body, in N²m² and N²: they are exact except for the accelerations.
WHOLE_BODY_VARIANCE = 1e-6

MAX_MERGE_RATIO = 1.01  # of the longest link: pushes of one side no further apart are one contact

LEFT_SIDE = 1
RIGHT_SIDE = -1
HEAD_TIP = 0


class EstimatedPush(NamedTuple):
    """An estimated force of an obstacle on a link."""

    link: int  # from 0 at the tail
    distance_from_rear_joint_m: float  # from the link's rear joint
    normal_l: Vector  # from the obstacle into the body
    force_n: float
    confidence: float  # 0 to 1: 1 - its standard deviation / force


@dataclass(frozen=True)
class _CandidatePush:
    """A push of 1 N at a place where an obstacle may push."""

    link: int
    side: int  # LEFT_SIDE, RIGHT_SIDE or HEAD_TIP
    distance_from_rear_joint_m: float  # from the link's rear joint
    generalized_force: Floats  # (n + 3,) left sides of all equations


def estimate_pushes(
    robot: RobotDescription,
    angles_rad: Sequence[float],
    velocities_rad_s: Sequence[float],
    torques_nm: Sequence[float],
    imu: Imu,
    pose: Pose | None,
) -> list[EstimatedPush]:
    """Estimate the forces of obstacles on the links from joint torques and accelerations.

    The equations of motion give the generalized force that inertia and joint torques leave unexplained. Friction and
    the fewest possible pushes from a fixed list of places are fitted to it.

    Args:
        robot: The description of the robot.
        angles_rad: (n_joints,) angles, tail to head, at the time of `imu`.
        velocities_rad_s: (n_joints,) velocities at the same time.
        torques_nm: (n_joints,) torques at the same time.
        imu: Angular velocities and specific forces of some links, or of none.
        pose: Velocity of the base; None if the links are assumed to slide forward along themselves.

    Returns:
        Pushes that are significant against the noise, tail to head.
    """
    chain = ChainDynamics.from_robot(robot, angles_rad)
    angular_velocities_rad_s = estimate_angular_velocities(chain, velocities_rad_s, imu)
    accelerations, accelerations_sd = estimate_accelerations(chain, angular_velocities_rad_s, imu)
    inertia = compute_inertia_terms(chain, angular_velocities_rad_s)
    joint_count = len(torques_nm)
    is_yaw: NDArray[np.bool_] = np.any(chain.axes_b != 0.0, axis=1)

    # What inertia and joint torques leave unexplained, (n_joints + 3,). Joints that do not bend in the plane have no
    # equation, which a row of zeros stands for.
    right_side = inertia @ np.append(accelerations, 1.0)
    right_side[:joint_count] -= np.where(is_yaw, torques_nm, 0.0)
    right_side[:joint_count] *= is_yaw

    # Covariance of the right side: of torques, of accelerations, and of how the links share the friction.
    friction, friction_sd = compute_unit_friction(chain, angular_velocities_rad_s, pose)
    inertia_sd = inertia[:, :-1] @ accelerations_sd
    torque_variances = np.full(joint_count, TORQUE_SD_NM**2)
    whole_body_variances = np.full(3, WHOLE_BODY_VARIANCE)  # of the total force (x, y) and moment
    covariance = np.diag(np.append(torque_variances, whole_body_variances))
    covariance += inertia_sd @ inertia_sd.T + friction_sd @ friction_sd.T

    # Whitening scales the equations to uncorrelated noise of standard deviation 1.
    candidate_pushes = _list_candidate_pushes(chain)
    columns = np.column_stack([friction, *(push.generalized_force for push in candidate_pushes)])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    forces_n, force_covariance = fit_fewest_columns(whitening @ columns, whitening @ right_side)
    return _merge_pushes(chain, candidate_pushes, forces_n[1:], force_covariance[1:, 1:])


class _CandidatePosition(NamedTuple):
    """A position on the skin at which an obstacle may push."""

    link: int
    side: int  # LEFT_SIDE, RIGHT_SIDE or HEAD_TIP
    end_fraction: float  # 0.0 at the rear end of the link, 1.0 at its front end


def _list_candidate_pushes(chain: ChainDynamics) -> list[_CandidatePush]:
    """Return a push of 1 N at every candidate position, with its generalized force in the equations of motion.

    Candidate positions are on both sides of both ends of each link, and on the tip of the head. Suffix `_l` is the
    frame of the link, suffix `_b` the frame of the base.

    Args:
        chain: Lengths, radii, positions and rotations of the links, and the Jacobians of points on them.

    Returns:
        The pushes, from the tail to the head.
    """
    last_link = len(chain.rear_b) - 1
    candidates: list[_CandidatePosition] = []
    for link in range(last_link + 1):
        for side in (LEFT_SIDE, RIGHT_SIDE):
            candidates += [_CandidatePosition(link, side, 0.0), _CandidatePosition(link, side, 1.0)]
    candidates.append(_CandidatePosition(last_link, HEAD_TIP, 1.0))

    links = np.array([candidate.link for candidate in candidates])
    end_fractions = np.array([candidate.end_fraction for candidate in candidates])
    outward_l = np.array([_get_outward_normal_l(candidate.side) for candidate in candidates])
    distances_from_rear_m = end_fractions * chain.lengths_m[links]
    surface_points_l = (
        distances_from_rear_m[:, None] * [1.0, 0.0, 0.0] + chain.radii_m[links, None] * outward_l
    )
    base_from_link = chain.frames[links]
    # Rotate the vector of each candidate from the frame of its link to that of the base.
    points_b = chain.rear_b[links] + np.einsum("kij,kj->ki", base_from_link, surface_points_l)
    forces_b = -np.einsum("kij,kj->ki", base_from_link, outward_l)
    generalized_forces = chain.compute_generalized_forces(links, points_b, forces_b)
    return [
        _CandidatePush(candidate.link, candidate.side, distance_m, generalized_force)
        for candidate, distance_m, generalized_force in zip(
            candidates, distances_from_rear_m.tolist(), generalized_forces.T, strict=True
        )
    ]


def _get_outward_normal_l(side: int) -> list[float]:
    """Return the outward normal of the skin on one side of a link, in the frame of the link."""
    if side == HEAD_TIP:
        return [1.0, 0.0, 0.0]
    return [0.0, side, 0.0]


def _merge_pushes(
    chain: ChainDynamics,
    candidate_pushes: Sequence[_CandidatePush],
    forces_n: Floats,
    covariance: Floats,
) -> list[EstimatedPush]:
    """Merge neighboring unit pushes on one side into one push, and leave out the insignificant results.

    Args:
        chain: Lengths of the links.
        candidate_pushes: The p candidate pushes of 1 N.
        forces_n: (p,) force of each unit push; 0 where there is none.
        covariance: (p, p) covariance of the forces in N².

    Returns:
        The pushes whose force is at least MIN_SIGNIFICANCE_SD times its standard deviation, sorted.
    """
    # Arc length at which each link begins.
    link_starts_m = np.append(0.0, np.cumsum(chain.lengths_m))
    max_gap_m = MAX_MERGE_RATIO * chain.lengths_m.max()
    merged: list[EstimatedPush] = []
    for side in (LEFT_SIDE, RIGHT_SIDE, HEAD_TIP):
        indices = [
            i for i, push in enumerate(candidate_pushes) if push.side == side and forces_n[i] > 0.0
        ]
        if not indices:
            continue
        candidates_s_m = np.array(
            [
                link_starts_m[candidate_pushes[i].link]
                + candidate_pushes[i].distance_from_rear_joint_m
                for i in indices
            ]
        )
        order = np.argsort(candidates_s_m, kind="stable")
        group_starts = np.flatnonzero(np.diff(candidates_s_m[order]) > max_gap_m) + 1
        for group in np.split(order, group_starts):
            member_indices = [indices[i] for i in group]
            force_n = float(forces_n[member_indices].sum())
            sd_n = float(np.sqrt(covariance[np.ix_(member_indices, member_indices)].sum()))
            if force_n < MIN_SIGNIFICANCE_SD * sd_n:
                continue
            body_s_m = float(forces_n[member_indices] @ candidates_s_m[group]) / force_n
            merged.append(_make_estimated_push(link_starts_m, side, body_s_m, force_n, sd_n))
    return sorted(merged)


def _make_estimated_push(
    link_starts_m: Floats, side: int, body_s_m: float, force_n: float, sd_n: float
) -> EstimatedPush:
    """Make a push at an arc length along the body.

    Args:
        link_starts_m: (n_links + 1,) arc lengths at which the links begin, and the length of the body.
        side: LEFT_SIDE, RIGHT_SIDE or HEAD_TIP.
        body_s_m: Arc length of the push from the tail end.
        force_n: Force of the push.
        sd_n: Standard deviation of the force.
    """
    last_link = len(link_starts_m) - 2
    link = min(int(np.searchsorted(link_starts_m, body_s_m, side="right")) - 1, last_link)
    normal_l = (-1.0, 0.0, 0.0) if side == HEAD_TIP else (0.0, -float(side), 0.0)
    return EstimatedPush(
        link=link,
        distance_from_rear_joint_m=body_s_m - float(link_starts_m[link]),
        normal_l=normal_l,
        force_n=force_n,
        confidence=1.0 - sd_n / force_n,
    )

"""The obstacle triplet model: contact forces and joint torques for a propulsion force, in the plane.

The equations are those of the paper's section IV-A, solved at once. The obstacles push along their normals only (no
friction), `f_i = lambda_i n_i`, and an imagined tether at o_1 pulls back with `f_s = -propulsion t_1`. Balance of
forces (10) and of moments (11) are three linear equations for the three lambda_i:

    sum lambda_i n_i = propulsion t_1        sum lambda_i (o_i x n_i) = propulsion (o_1 x t_1)

A correction to the paper. Its equation (3), `f_tau = r x tau`, has the unit N·m² and cannot be a force. What a torque
tau on the part of the body ahead of the joint does at o_3, a lever r away, is `f_tau = (r x tau) / |r|²`, for which
`r x f_tau = -tau` holds. With 1/|r|² carried into (5)-(9) the paper's path from torque to forces gives the same numbers
as the linear solve here; a test does both. Planar vectors cross to a scalar: `a x b = a_x b_y - a_y b_x`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from snakesim_gnc.geometry.planar import compute_wrenches, cross_2d
from snakesim_hal.base.arrays import Floats

Planar = tuple[float, float] | Floats

CONDITION_MAX = 100.0  # default; above it, errors of the contact points are amplified too much
AUTHORITY_MIN = 0.02  # default; sine of the angle between the lever and the normal at o_3
UNIT_TOLERANCE = 1e-6  # of the length of a unit vector


@dataclass(frozen=True)
class UnitForces:
    """Forces of three contacts for each newton of propulsion."""

    forces: Floats  # (3,) N/N, tail to head; NaN where the balance has no unique solution
    # Of the balance, with lengths in units of the triplet's span; infinite when singular.
    condition: float
    reason: str  # why these contacts cannot propel; empty when they can


@dataclass(frozen=True)
class TripletSolution:
    """Forces of three contacts and torque of one joint for a propulsion force."""

    # (3,) tail to head, along the normals; NaN where the balance has no unique solution.
    forces_n: Floats
    torque_nm: float  # internal torque on the part of the body ahead of the joint, left turn positive; NaN like forces
    condition: float
    is_feasible: bool
    reason: str  # empty when feasible


def solve_triplet(
    points_w: ArrayLike,
    normals_w: ArrayLike,
    tangent_1_w: ArrayLike,
    propulsion_n: float,
    joint_w: ArrayLike,
    *,
    condition_max: float = CONDITION_MAX,
    authority_min: float = AUTHORITY_MIN,
) -> TripletSolution:
    """Compute the contact forces, and the torque of one joint between o_2 and o_3, that balance a propulsion force.

    Args:
        points_w: (3, 2) m, o_1, o_2, o_3 from tail to head.
        normals_w: (3, 2) unit vectors, from the obstacle into the body.
        tangent_1_w: (2,) unit vector along the body at o_1 towards the head; the tether pulls along its negative.
        propulsion_n: Size of the tether's force.
        joint_w: (2,) m, where the torque acts.
        condition_max: Maximum condition number of the balance, with lengths in units of |o_3 - o_1|.
        authority_min: Minimum of |r x n_3| / |r|, where r reaches from the joint to o_3.

    Returns:
        The solution. It is not feasible, with the reason, if the balance is ill-conditioned, if a contact would have to
        pull (lambda_i <= 0), or if the joint has no authority, because r is parallel to n_3.

    Raises:
        ValueError: Wrong shapes, NaN, directions that are not unit vectors, or a propulsion force that is not positive.
    """
    points = _check_array("points_w", points_w, (3, 2))
    normals = _check_array("normals_w", normals_w, (3, 2))
    tangent = _check_array("tangent_1_w", tangent_1_w, (2,))
    joint = _check_array("joint_w", joint_w, (2,))
    _check_unit_vectors("normals_w", normals)
    _check_unit_vectors("tangent_1_w", tangent[None])
    if not (math.isfinite(propulsion_n) and propulsion_n > 0):
        raise ValueError(f"propulsion_n = {propulsion_n} N must be a finite force above 0")
    (unit,) = solve_unit_forces(
        points[None], normals[None], tangent[None], condition_max=condition_max
    )
    forces_n = propulsion_n * unit.forces
    torque_nm = propulsion_n * compute_torque_per_newton(
        unit.forces[2], points[2], normals[2], joint
    )
    reason = unit.reason or find_authority_problem(points[2], normals[2], joint, authority_min)
    return TripletSolution(
        forces_n=forces_n,
        torque_nm=torque_nm,
        condition=unit.condition,
        is_feasible=not reason,
        reason=reason,
    )


def solve_unit_forces(
    points_w: Floats,
    normals_w: Floats,
    tangents_1_w: Floats,
    *,
    condition_max: float = CONDITION_MAX,
) -> list[UnitForces]:
    """Compute the contact forces for 1 N of propulsion of m triplets at once. Arguments are not checked.

    For each triplet it solves A lambda = b, equations (10) and (11) for 1 N, with lever arms a_i = (o_i - o_mean) / L
    about the mean of the three points and in units of their span L = |o_3 - o_1|:

        A = [  n_1x       n_2x       n_3x     ]      b = [  t_1x      ]
            [  n_1y       n_2y       n_3y     ]          [  t_1y      ]
            [ a_1 x n_1  a_2 x n_2  a_3 x n_3 ]          [ a_1 x t_1  ]

    Args:
        points_w: (m, 3, 2) m, o_1, o_2, o_3 from tail to head.
        normals_w: (m, 3, 2) unit vectors, from the obstacle into the body.
        tangents_1_w: (m, 2) unit vectors along the body at o_1 towards the head.
        condition_max: A is not solved above this condition number.

    Returns:
        For each triplet the forces along the normals, the condition number of A, and why it cannot propel.
    """
    span_w = points_w[:, 2] - points_w[:, 0]
    span_m = np.hypot(span_w[:, 0], span_w[:, 1])
    has_span = span_m > 0.0
    unit_m = np.where(has_span, span_m, 1.0)
    arms = (points_w - points_w.mean(axis=1, keepdims=True)) / unit_m[:, None, None]

    moments = cross_2d(arms, normals_w)
    a = np.concatenate([normals_w.swapaxes(1, 2), moments[:, None]], axis=1)  # (m, 3, 3)
    tether_moments = cross_2d(arms[:, 0], tangents_1_w)
    b = np.concatenate([tangents_1_w, tether_moments[:, None]], axis=1)  # (m, 3)

    conditions = np.where(has_span, np.linalg.cond(a), np.inf)
    is_well_conditioned = conditions <= condition_max
    forces = np.full((len(span_m), 3), np.nan)  # lambda
    forces[is_well_conditioned] = np.linalg.solve(
        a[is_well_conditioned], b[is_well_conditioned, :, None]
    )[..., 0]

    results: list[UnitForces] = []
    for forces_of_triplet, condition, length_m in zip(
        forces, conditions.tolist(), span_m.tolist(), strict=True
    ):
        reason = _find_propulsion_problem(
            length_m, condition, condition_max, forces_of_triplet.tolist()
        )
        results.append(UnitForces(forces_of_triplet, condition, reason))
    return results


def _find_propulsion_problem(
    span_m: float, condition: float, condition_max: float, forces: list[float]
) -> str:
    """Return why three contacts cannot propel the body; an empty text if they can.

    Args:
        span_m: Distance between o_1 and o_3.
        condition: Condition number of the balance of forces and moments.
        condition_max: Maximum condition number.
        forces: Contact forces lambda_1 to lambda_3 for 1 N of propulsion.
    """
    if span_m <= 0.0:
        return "o_1 and o_3 are the same point"
    if not condition <= condition_max:  # also true for NaN
        condition_text = f"the three normals (nearly) meet in a point or are parallel (condition {condition:.3g})"
        return f"ill-conditioned: {condition_text}"
    pulling = [
        f"lambda_{i + 1} = {force:.3g} N/N" for i, force in enumerate(forces) if force <= 0.0
    ]
    if pulling:
        return f"a contact would have to pull: {', '.join(pulling)}"
    return ""


def compute_torque_per_newton(
    unit_force_3: float, point_3_w: Planar, normal_3_w: Planar, joint_w: Planar
) -> float:
    """Return the torque on the part ahead of a joint between o_2 and o_3, in N·m per newton of propulsion.

    It is -lambda_3 (r x n_3), where r reaches from the joint to o_3.

    Args:
        unit_force_3: lambda_3 for 1 N of propulsion.
        point_3_w: (2,) m, o_3.
        normal_3_w: (2,) unit vector, n_3.
        joint_w: (2,) m, where the torque acts.
    """
    # Single numbers instead of arrays: this runs for each triplet in every tick.
    x, y = point_3_w
    nx, ny = normal_3_w
    joint_x, joint_y = joint_w
    r_cross_n = (x - joint_x) * ny - (y - joint_y) * nx
    return float(-unit_force_3 * r_cross_n)


def find_authority_problem(
    point_3_w: Planar, normal_3_w: Planar, joint_w: Planar, authority_min: float
) -> str:
    """Return why a torque of the joint does not press on the contact at o_3; an empty text if it does.

    With r from the joint to o_3, the joint has authority if |r x n_3| >= authority_min |r|.

    Args:
        point_3_w: (2,) o_3 in the world, m.
        normal_3_w: (2,) unit vector n_3.
        joint_w: (2,) position of the joint, m.
        authority_min: Minimum sine of the angle between r and n_3.
    """
    x, y = point_3_w
    nx, ny = normal_3_w
    joint_x, joint_y = joint_w
    lever_m = math.hypot(x - joint_x, y - joint_y)
    r_cross_n = (x - joint_x) * ny - (y - joint_y) * nx
    if lever_m > 0 and abs(r_cross_n) >= authority_min * lever_m:
        return ""
    return "no authority: the line from the joint to o_3 is parallel to the normal there"


def compute_bending_torque_nm(
    joints_w: ArrayLike,
    joints_s_m: ArrayLike,
    points_w: ArrayLike,
    points_s_m: ArrayLike,
    forces_w: ArrayLike,
) -> Floats:
    """Compute the internal torque at every joint that balances the forces ahead of it; equation (12).

    The torque acts on the part ahead of the joint, left turn positive. It is the negative sum of the moments about the
    joint of all forces ahead of it. If all forces are in balance, that is the sum of the moments of all forces behind.

    Args:
        joints_w: (n, 2) positions of the joints, m.
        joints_s_m: (n,) arc lengths of the joints from the tail end along the body.
        points_w: (k, 2) positions of the points at which forces act on the body, m.
        points_s_m: (k,) arc lengths of these points from the tail end along the body.
        forces_w: (k, 2) forces at these points in N, the tether's force included.

    Returns:
        (n,) torques in N·m.
    """
    wrenches = compute_wrenches(np.asarray(points_w), np.asarray(forces_w))
    return compute_joint_torques(
        np.asarray(joints_w), np.asarray(joints_s_m), np.asarray(points_s_m), wrenches
    )


def compute_joint_torques(
    joints_w: Floats, joints_s_m: Floats, points_s_m: Floats, wrenches: Floats
) -> Floats:
    """Compute the internal torque at every joint that balances the wrenches ahead of the joint.

    With the sums F and M over all wrenches ahead of a joint at p, M about the origin: torque = p x F - M.

    Args:
        joints_w: (n, 2) positions of the joints, m.
        joints_s_m: (n,) arc lengths of the joints from the tail end along the body.
        points_s_m: (k,) arc lengths of the points at which forces act, from the tail end along the body.
        wrenches: (k, 3) force x and y in N, and moment about the origin in N·m.

    Returns:
        (n,) torques in N·m on the part of the body ahead of each joint, left turn positive.
    """
    is_ahead = (points_s_m > joints_s_m[:, None]).astype(np.float64)
    x_force, y_force, moment = (is_ahead @ wrenches).T
    return joints_w[:, 0] * y_force - joints_w[:, 1] * x_force - moment


def add_tether_force(forces_n: ArrayLike, normals_w: ArrayLike, tether_w: ArrayLike) -> Floats:
    """Return the forces at the three contacts as vectors, with the tether's force added at o_1.

    Args:
        forces_n: (3,) contact forces along the normals in N, tail to head.
        normals_w: (3, 2) unit vectors from the obstacles into the body.
        tether_w: (2,) force of the tether in N.

    Returns:
        (3, 2) forces in N.
    """
    forces_w = np.asarray(forces_n)[:, None] * np.asarray(normals_w)
    forces_w[0] += tether_w
    return forces_w


def _check_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return a value as an array after a check of its shape. Raises ValueError."""
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite: {array.tolist()}")
    return array


def _check_unit_vectors(name: str, vectors_w: Floats) -> None:
    """Check that all vectors (n, 2) have length 1. Raises ValueError."""
    lengths = np.hypot(vectors_w[:, 0], vectors_w[:, 1])
    if np.abs(lengths - 1.0).max() > UNIT_TOLERANCE:
        raise ValueError(f"{name} must be unit vectors; their lengths are {lengths.tolist()}")

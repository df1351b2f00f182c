"""The obstacle triplet model: contact forces and joint torques for a propulsion force. Pure and planar.

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

from snakesim_gnc.geometry.planar import cross, wrenches
from snakesim_hal.base.arrays import Floats

Planar = tuple[float, float] | Floats

CONDITION_MAX = 100.0
AUTHORITY_MIN = 0.02
UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class UnitForces:
    """Forces of three contacts for each newton of propulsion."""

    forces: Floats  # (3,) N/N, tail to head; NaN where the contacts decide nothing
    condition: float  # of the balance, with lengths in units of the triplet's span; infinite when singular
    reason: str  # why these contacts cannot propel; empty when they can


@dataclass(frozen=True)
class TripletSolution:
    """Forces of three contacts and torque of one joint for a propulsion force."""

    forces_n: Floats  # (3,) tail to head, along the normals; NaN when the contacts decide nothing
    torque_nm: float  # internal torque on the part of the body ahead of the joint, left turn positive; NaN like forces
    condition: float
    feasible: bool
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
    """Contact forces, and the torque of one joint between o_2 and o_3, that hold a propulsion force in balance.

    points_w: (3, 2) m, o_1, o_2, o_3 from tail to head. normals_w: (3, 2) unit, from the obstacle into the body.
    tangent_1_w: (2,) unit, along the body at o_1 towards the head; the tether pulls along its negative.
    propulsion_n: size of the tether's force. joint_w: (2,) m, where the torque acts.

    Not feasible, with the reason, when the balance is ill-conditioned (its condition number, with lengths in units of
    |o_3 - o_1|, exceeds `condition_max`), when a contact would have to pull (lambda_i <= 0), or when the joint has no
    authority: r, from the joint to o_3, is parallel to n_3 (|r x n_3| / |r| below `authority_min`).
    Raises ValueError for invalid arguments: wrong shapes, NaN, directions that are not unit
    vectors, a propulsion force that is not positive.
    """
    points = _planar("points_w", points_w, (3, 2))
    normals = _planar("normals_w", normals_w, (3, 2))
    tangent = _planar("tangent_1_w", tangent_1_w, (2,))
    joint = _planar("joint_w", joint_w, (2,))
    for name, vectors in (("normals_w", normals), ("tangent_1_w", tangent[None])):
        sizes = np.hypot(vectors[:, 0], vectors[:, 1])
        if np.abs(sizes - 1.0).max() > UNIT_TOLERANCE:
            raise ValueError(f"{name} must be unit vectors; their lengths are {sizes.tolist()}")
    if not (math.isfinite(propulsion_n) and propulsion_n > 0):
        raise ValueError(f"propulsion_n = {propulsion_n} N must be a finite force above 0")
    (unit,) = unit_forces(points[None], normals[None], tangent[None], condition_max=condition_max)
    forces = propulsion_n * unit.forces
    torque = propulsion_n * torque_per_newton(unit.forces[2], points[2], normals[2], joint)
    reason = unit.reason or no_authority(points[2], normals[2], joint, authority_min)
    return TripletSolution(forces, torque, unit.condition, not reason, reason)


def unit_forces(
    points_w: Floats, normals_w: Floats, tangents_1_w: Floats, *, condition_max: float = CONDITION_MAX
) -> list[UnitForces]:
    """The contact forces for 1 N of propulsion of m triplets at once.

    points_w, normals_w: (m, 3, 2). tangents_1_w: (m, 2). Otherwise as in `solve_triplet`, and not checked.
    """
    spans = np.hypot(*(points_w[:, 2] - points_w[:, 0]).T)
    arms = (points_w - points_w.mean(axis=1, keepdims=True)) / np.where(spans > 0.0, spans, 1.0)[:, None, None]
    balance = np.concatenate([normals_w.swapaxes(1, 2), cross(arms, normals_w)[:, None]], axis=1)
    conditions = np.where(spans > 0.0, np.linalg.cond(balance), np.inf)
    pull = np.concatenate([tangents_1_w, cross(arms[:, 0], tangents_1_w)[:, None]], axis=1)
    forces, solvable = np.full((len(spans), 3), np.nan), conditions <= condition_max
    forces[solvable] = np.linalg.solve(balance[solvable], pull[solvable, :, None])[..., 0]
    return [
        UnitForces(unit, condition, _why_not(span, condition, condition_max, unit.tolist()))
        for unit, condition, span in zip(forces, conditions.tolist(), spans.tolist(), strict=True)
    ]


def _why_not(span_m: float, condition: float, condition_max: float, forces: list[float]) -> str:
    """Why three contacts cannot propel; empty when they can."""
    if span_m <= 0.0:
        return "o_1 and o_3 are the same point"
    if not condition <= condition_max:
        why = f"the three normals (nearly) meet in a point or are parallel (condition {condition:.3g})"
        return f"ill-conditioned: {why}"
    pulling = [f"lambda_{i + 1} = {force:.3g} N/N" for i, force in enumerate(forces) if force <= 0.0]
    return f"a contact would have to pull: {', '.join(pulling)}" if pulling else ""


def torque_per_newton(unit_force_3: float, point_3_w: Planar, normal_3_w: Planar, joint_w: Planar) -> float:
    """Torque on the part ahead of a joint between o_2 and o_3, per newton of propulsion: -lambda_3 (r x n_3)."""
    (x, y), (nx, ny), (px, py) = point_3_w, normal_3_w, joint_w
    return float(-unit_force_3 * ((x - px) * ny - (y - py) * nx))


def no_authority(point_3_w: Planar, normal_3_w: Planar, joint_w: Planar, least: float) -> str:
    """Why a torque of the joint does not reach the contact at o_3; empty when it does."""
    (x, y), (nx, ny), (px, py) = point_3_w, normal_3_w, joint_w
    lever = math.hypot(x - px, y - py)
    if lever > 0 and abs((x - px) * ny - (y - py) * nx) >= least * lever:
        return ""
    return "no authority: the line from the joint to o_3 is parallel to the normal there"


def bending_torque_nm(
    joints_w: ArrayLike, joints_s_m: ArrayLike, points_w: ArrayLike, points_s_m: ArrayLike, forces_w: ArrayLike
) -> Floats:
    """Internal torque at every joint that holds the forces ahead of it in balance; equation (12), (n_joints,) N·m.

    joints_w: (n, 2) m. joints_s_m: (n,) m from the tail end along the body. points_w, points_s_m, forces_w: (k, 2),
    (k,) and (k, 2), where and with what the body is pushed, the tether's force included. Torque on the part ahead,
    left turn positive: the negative sum of the moments about the joint of all forces ahead of it. With forces in
    balance that is the sum of the moments of all forces behind it.
    """
    pushes = wrenches(np.asarray(points_w), np.asarray(forces_w))
    return torque_under(np.asarray(joints_w), np.asarray(joints_s_m), np.asarray(points_s_m), pushes)


def torque_under(joints_w: Floats, joints_s_m: Floats, points_s_m: Floats, wrenches: Floats) -> Floats:
    """`bending_torque_nm` for pushes whose wrenches (k, 3) are known already."""
    ahead = (points_s_m > joints_s_m[:, None]).astype(np.float64)
    x_force, y_force, moment = (ahead @ wrenches).T
    return joints_w[:, 0] * y_force - joints_w[:, 1] * x_force - moment


def loads(forces_n: ArrayLike, normals_w: ArrayLike, tether_w: ArrayLike) -> Floats:
    """The forces at the three points, (3, 2) N: the contacts', and at o_1 the tether's as well."""
    forces = np.asarray(forces_n)[:, None] * np.asarray(normals_w)
    forces[0] += tether_w
    return forces


def _planar(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite: {array.tolist()}")
    return array

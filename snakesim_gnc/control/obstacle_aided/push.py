"""Finds the forces on obstacles that push a body forward, and the joint torques that produce them.

Symbols, for a body of length L between obstacles:

    o_c, n_c, t_c    point, normal (out of the obstacle) and tangent (along the body) of contact c
    d_c              n_c - mu t_c, the direction in which contact c pushes, with the friction coefficient mu
    lambda_c >= 0    size of the push of contact c: the force is lambda_c d_c
    gamma, t         a point of the body, and the tangent there
    p_i, theta_i'    place of joint i, and how far it turns per meter that the body advances on its path

Forces that push with F along the body balance a drag that is distributed evenly over its length. So do the forces on
the part of the body ahead of each joint i, with its torque tau_i:

    sum_c lambda_c [d_c ; o_c x d_c] = (F/L) integral [t ; gamma x t] d sigma
    tau_i = - sum_{c ahead of i} lambda_c (o_c - p_i) x d_c + (F/L) integral_{ahead of i} (gamma - p_i) x t d sigma

If the body advances by ds, joint i turns by theta_i' ds, and F ds = sum_i tau_i theta_i' ds. Some joints may do more
than all of this work while others absorb the excess. So of all such forces, those with the smallest sum of squares of
tau_i theta_i' are chosen, and among these the smallest forces. The cost of a force grows with the gap of its contact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import cross_2d
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import (
    LINK_FRACTIONS,
    ObstacleOutlines,
    find_nearest_points_on_chain,
)
from snakesim_hal.wire.messages import WorldModel

# |n . t| of a contact; above it, the obstacle stands in front of the head.
MAX_NORMAL_ALONG_BODY = 0.6
# Unbalanced fraction of the force up to which contacts count as able to push.
MAX_BALANCE_RESIDUAL = 0.05
MAX_SOLVER_ITERATIONS = 30  # of the solver; it needs one for each contact that carries force
MIN_GRADIENT = 1e-9  # contacts with a smaller gradient do not improve the solution

# Weights of the three parts of the least-squares problem.
BALANCE_WEIGHT = 10.0  # balance of forces and moment
WORK_WEIGHT = 0.05  # work of the joints, tau_i theta_i'
FORCE_WEIGHT = 0.02  # size of the forces


@dataclass(frozen=True)
class BodyContacts:
    """Contacts of a body with obstacles that it touches, or nearly touches; one row for each of k contacts."""

    obstacle_index: NDArray[np.intp]  # (k,) index of the obstacle
    positions_w: Floats  # (k, 2) m, o_c on the surface of the body
    directions_w: Floats  # (k, 2), d_c: direction of the push, friction included
    tangents_w: Floats  # (k, 2), t_c: unit vectors along the body, towards the head
    body_s_m: Floats  # (k,) arc length from the tail end
    gap_m: Floats  # (k,)

    def __len__(self) -> int:
        return len(self.gap_m)


@dataclass(frozen=True)
class NormalizedPush:
    """Contact forces and joint torques, normalized to a push of 1 N along the body."""

    contact_forces: Floats  # (k,) N/N, the multipliers lambda_c of the contacts' push directions
    joint_torques_nm: Floats  # (n_joints,) N·m/N, of the joints that bend
    balance_residual: float  # |A lambda - b|: fraction of the push that the contacts do not balance

    @property
    def is_balanced(self) -> bool:
        """Whether these contacts can push at all."""
        return self.balance_residual < MAX_BALANCE_RESIDUAL and bool(
            (self.contact_forces > 0.0).any()
        )


@dataclass(frozen=True)
class PushSnapshot:
    """The contacts of a world model, and the push that they allow."""

    world: WorldModel
    contacts: BodyContacts
    push: NormalizedPush


class PushLowPassFilter:
    """First-order low-pass filter of pushes.

    Pose noise moves much of the force from one contact to another in every solution; the filter averages this.
    """

    def __init__(self, time_constant_s: float) -> None:
        self._time_constant_s = time_constant_s
        # The last output. Contacts are identified by the names of their obstacles.
        self._last_time_s = -np.inf
        self._last_forces_by_obstacle: dict[str, float] = {}
        self._last_joint_torques_nm: Floats | float = 0.0
        self._last_residual = 0.0

    def update(
        self, time_s: float, push: NormalizedPush, obstacles: Sequence[str]
    ) -> NormalizedPush:
        """Filter the contact forces of a push by a low-pass filter of first order, contact by contact.

        With the time dt since the last push, decay = exp(-dt / time constant) and alpha = 1 - decay, the output is
        alpha * new + decay * last. A contact that the last push did not have starts at zero.

        Args:
            time_s: Time of the push.
            push: The new, unfiltered push.
            obstacles: (k,) names of the obstacles of its contacts, which identify contacts from push to push.

        Returns:
            The filtered push, with the same k contacts.
        """
        decay = float(np.exp((self._last_time_s - time_s) / self._time_constant_s))
        alpha = 1.0 - decay
        filtered_forces: list[float] = []
        for name, new_force in zip(obstacles, push.contact_forces, strict=True):
            filtered_forces.append(
                alpha * new_force + decay * self._last_forces_by_obstacle.get(name, 0.0)
            )
        joint_torques_nm = alpha * push.joint_torques_nm + decay * self._last_joint_torques_nm
        balance_residual = alpha * push.balance_residual + decay * self._last_residual
        self._last_time_s = time_s
        self._last_forces_by_obstacle = dict(zip(obstacles, filtered_forces, strict=True))
        self._last_joint_torques_nm = joint_torques_nm
        self._last_residual = balance_residual
        return NormalizedPush(np.array(filtered_forces), joint_torques_nm, balance_residual)


def find_body_contacts(
    body_points_w: Floats,
    radius_m: float,
    outlines: ObstacleOutlines,
    *,
    max_gap_m: float,
    friction: float,
) -> BodyContacts:
    """Find the point of the body that is nearest to each obstacle within reach and beside the body.

    Args:
        body_points_w: (2, n) points of the body's center line (tail end, joints, head end) in the world, m.
        radius_m: Radius of the body.
        outlines: Outlines of all obstacles.
        max_gap_m: Maximum gap between skin and obstacle that still counts as a contact.
        friction: Friction coefficient mu between body and obstacles.

    Returns:
        The k contacts, each with its position on the skin, its direction of push, and its gap.
    """
    samples, nearest_w, distances_m = find_nearest_points_on_chain(body_points_w.T, outlines)
    near_obstacles = np.flatnonzero(distances_m - radius_m < max_gap_m)
    center_w = nearest_w[near_obstacles]  # (k, 2) on the center line
    link, fraction_index = np.divmod(samples[near_obstacles], len(LINK_FRACTIONS))

    # Normal, tangent and arc length of each contact.
    link_vectors_w = np.diff(body_points_w, axis=1).T  # (n_links, 2)
    lengths_m = np.hypot(*link_vectors_w.T)
    distance_m, normal = outlines.compute_distances_and_normals(center_w, near_obstacles)
    tangent = (link_vectors_w / lengths_m[:, None])[link]
    link_start_m = np.concatenate(([0.0], np.cumsum(lengths_m)[:-1]))
    body_s_m = link_start_m[link] + LINK_FRACTIONS[fraction_index] * lengths_m[link]

    # Sliding friction acts on the body against its motion along the tangent.
    direction = normal - friction * tangent

    # An obstacle in front of the head or behind the tail, whose normal is along the body, cannot be pushed sideways.
    normal_along_body = np.abs(np.einsum("ij,ij->i", normal, tangent))
    beside_body = np.flatnonzero(normal_along_body < MAX_NORMAL_ALONG_BODY)
    return BodyContacts(
        obstacle_index=near_obstacles[beside_body],
        positions_w=(center_w - radius_m * normal)[beside_body],
        directions_w=direction[beside_body],
        tangents_w=tangent[beside_body],
        body_s_m=body_s_m[beside_body],
        gap_m=(distance_m - radius_m)[beside_body],
    )


def solve_push(
    body_points_w: Floats,
    contacts: BodyContacts,
    joint_slopes_rad_per_m: Floats,
    *,
    contact_gap_scale_m: float,
    extra_cost: Floats | float = 0.0,
) -> NormalizedPush:
    """Solve for the contact forces and joint torques that push with 1 N along the body.

    Minimizes, over lambda >= 0 and with W = diag(1 + gap_c / contact_gap_scale_m + extra_cost_c),

        |BALANCE_WEIGHT (A lambda - b)|^2 + sum_i (WORK_WEIGHT theta_i' tau_i)^2 + |FORCE_WEIGHT W lambda|^2

    where A lambda = b is the balance of forces and moments, and tau = lever lambda + drag_torque. Moments are taken
    about the center of the body.

    Args:
        body_points_w: (2, n) points of the body's center line (tail end, joints, head end) in the world, m.
        contacts: The k contacts that may push.
        joint_slopes_rad_per_m: (n_joints,) theta_i', derivatives of the joint angles by the arc length of the body on
            its path, of the joints that bend.
        contact_gap_scale_m: Gap at which the force of a contact costs twice as much as without a gap.
        extra_cost: (k,) terms that are added to the cost weights of the contacts, or one term for all.

    Returns:
        The contact forces lambda and the joint torques tau for 1 N, and the residual |A lambda - b| of the balance.
    """
    # The links, (n_links, 2) and (n_links,), and the center of the body, about which moments are taken.
    link_rear_ends_w = body_points_w[:, :-1].T
    link_vectors_w = np.diff(body_points_w, axis=1).T
    lengths_m = np.hypot(*link_vectors_w.T)
    middles_w = link_rear_ends_w + 0.5 * link_vectors_w
    tangents = link_vectors_w / lengths_m[:, None]
    length_fraction = lengths_m / lengths_m.sum()  # the drag of each link, for 1 N in sum
    center_w = length_fraction @ middles_w

    # The balance A lambda = b: the contacts push (A, with a column for each) against the drag of 1 N (b).
    drag_force = length_fraction @ tangents
    drag_moment = length_fraction @ cross_2d(middles_w - center_w, tangents)
    b = np.array([*drag_force, drag_moment])  # (3,)
    arms_m = contacts.positions_w - center_w
    # (3, k).
    a = np.column_stack([contacts.directions_w, cross_2d(arms_m, contacts.directions_w)]).T

    # The joint torques lever lambda + drag_torque. A joint carries the forces and the drag ahead of it.
    joints_w = body_points_w[:, 1:-1].T  # (n_joints, 2), p_i
    is_ahead = contacts.body_s_m[None, :] > np.cumsum(lengths_m)[:-1, None]
    lever = -(
        is_ahead
        * cross_2d(contacts.positions_w[None] - joints_w[:, None], contacts.directions_w[None])
    )
    link_is_ahead = np.triu(np.ones((len(joints_w), len(lengths_m)), dtype=bool), 1)
    drag_torque = (
        link_is_ahead * cross_2d(middles_w[None] - joints_w[:, None], tangents[None])
    ) @ length_fraction

    # Solve for x = W lambda, so that the last part of the cost is that of a unit matrix.
    weight = 1.0 + np.maximum(contacts.gap_m, 0.0) / contact_gap_scale_m + extra_cost
    work_cost = WORK_WEIGHT * np.abs(joint_slopes_rad_per_m)
    rows = [
        BALANCE_WEIGHT * a / weight,
        work_cost[:, None] * lever / weight,
        FORCE_WEIGHT * np.eye(len(contacts)),
    ]
    right_side = [BALANCE_WEIGHT * b, -work_cost * drag_torque, np.zeros(len(contacts))]
    lambdas = _solve_nonnegative(np.vstack(rows), np.concatenate(right_side)) / weight
    return NormalizedPush(
        contact_forces=lambdas,
        joint_torques_nm=lever @ lambdas + drag_torque,
        balance_residual=float(np.linalg.norm(a @ lambdas - b)),
    )


def _solve_nonnegative(matrix: Floats, right_side: Floats) -> Floats:
    """Return the x >= 0 that minimizes |matrix x - right_side|.

    Source: the active-set algorithm NNLS of Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.

    Args:
        matrix: (m, k) matrix.
        right_side: (m,) right-hand side.

    Returns:
        (k,) solution. After MAX_SOLVER_ITERATIONS it may not be the minimum.
    """
    variable_count = matrix.shape[1]
    x = np.zeros(variable_count)
    is_free = np.zeros(variable_count, dtype=bool)  # variables that may be above 0
    if variable_count == 0:
        return x
    for _ in range(MAX_SOLVER_ITERATIONS):
        gradient = matrix.T @ (right_side - matrix @ x)
        gradient[is_free] = -np.inf
        entering_index = int(np.argmax(gradient))
        if gradient[entering_index] < MIN_GRADIENT:
            break
        is_free[entering_index] = True
        x = _solve_free_variables(matrix, right_side, x, is_free)
    return x


def _solve_free_variables(
    matrix: Floats, right_side: Floats, x: Floats, is_free: NDArray[np.bool_]
) -> Floats:
    """Solve least squares for the free variables, and bind those at 0 that would become negative.

    Args:
        matrix: (m, k) matrix.
        right_side: (m,) right-hand side.
        x: (k,) current solution.
        is_free: (k,) which variables may be above 0; variables that are bound become False in this array.

    Returns:
        (k,) new solution, which is 0 for all variables that are not free.
    """
    while True:
        trial_solution = np.zeros(len(x))
        trial_solution[is_free] = np.linalg.lstsq(matrix[:, is_free], right_side, rcond=None)[0]
        if (trial_solution[is_free] > 0).all():
            return trial_solution
        # Go towards the trial until the first variable reaches 0.
        is_negative = is_free & (trial_solution <= 0)
        step_fraction = float(
            np.min(x[is_negative] / np.maximum(x[is_negative] - trial_solution[is_negative], 1e-12))
        )
        x = x + step_fraction * (trial_solution - x)
        is_free &= x > 1e-12
        if not is_free.any():
            return np.zeros(len(x))

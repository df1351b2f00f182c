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

from snakesim_gnc.geometry.planar import cross
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import LINK_FRACTIONS, Outlines, nearest_on_chain

MAX_NORMAL_ALONG_BODY = 0.6  # |n . t| of a contact; above it, the obstacle stands in front of the head
MAX_RESIDUAL = 0.05  # unbalanced fraction of the force up to which contacts count as able to push
MAX_ITERATIONS = 30  # of the solver; it needs one for each contact that carries force
MIN_GRADIENT = 1e-9  # contacts with a smaller gradient do not improve the solution

# Weights of the three parts of the least-squares problem.
BALANCE_WEIGHT = 10.0  # balance of forces and moment
WORK_WEIGHT = 0.05  # work of the joints, tau_i theta_i'
FORCE_WEIGHT = 0.02  # size of the forces


@dataclass(frozen=True)
class Touches:
    """Contacts of a body with obstacles that it touches, or nearly touches; one row for each of k contacts."""

    obstacle: NDArray[np.intp]  # (k,) index of the obstacle
    places_w: Floats  # (k, 2) m, o_c on the surface of the body
    directions_w: Floats  # (k, 2), d_c: direction of the push, friction included
    tangents_w: Floats  # (k, 2), t_c: unit vectors along the body, towards the head
    body_s_m: Floats  # (k,) arc length from the tail end
    gap_m: Floats  # (k,)

    def __len__(self) -> int:
        return len(self.gap_m)


@dataclass(frozen=True)
class UnitPush:
    """Contact forces and joint torques for a push of 1 N along the body."""

    lambdas: Floats  # (k,) N/N
    torques_nm: Floats  # (n_joints,) N·m/N, of the joints that bend
    residual: float  # fraction of the push that no contact can balance

    @property
    def balanced(self) -> bool:
        """Whether these contacts can push at all."""
        return self.residual < MAX_RESIDUAL and bool((self.lambdas > 0.0).any())


class PushFilter:
    """First-order low-pass filter of pushes.

    Pose noise moves much of the force from one contact to another in every solution; the filter averages this.
    """

    def __init__(self, filter_s: float) -> None:
        self._filter_s = filter_s  # time constant
        # Last output. Contacts are identified by the names of their obstacles.
        self._time_s = -np.inf
        self._lambdas: dict[str, float] = {}
        self._torques_nm: Floats | float = 0.0
        self._residual = 0.0

    def update(self, time_s: float, push: UnitPush, obstacles: Sequence[str]) -> UnitPush:
        """Filter the contact forces of a push by a low-pass filter of first order, contact by contact.

        Args:
            time_s: time of the push.
            push: the new, unfiltered push.
            obstacles: (k,) names of the obstacles of its contacts; they identify contacts from push to push.

        Returns:
            The filtered push, with the same k contacts.
        """
        last_gain = float(np.exp((self._time_s - time_s) / self._filter_s))
        new_gain = 1.0 - last_gain
        lambdas: list[float] = []
        for name, new_lambda in zip(obstacles, push.lambdas, strict=True):
            lambdas.append(new_gain * new_lambda + last_gain * self._lambdas.get(name, 0.0))
        torques_nm = new_gain * push.torques_nm + last_gain * self._torques_nm
        residual = new_gain * push.residual + last_gain * self._residual
        self._time_s = time_s
        self._lambdas = dict(zip(obstacles, lambdas, strict=True))
        self._torques_nm = torques_nm
        self._residual = residual
        return UnitPush(np.array(lambdas), torques_nm, residual)


def find_touches(nodes_w: Floats, radius_m: float, outlines: Outlines, *, reach_m: float, friction: float) -> Touches:
    """Find the point of the body that is nearest to each obstacle within reach and beside the body.

    Args:
        nodes_w: (2, n) m, nodes of the body's center line, tail to head.
        radius_m: radius of the body.
        outlines: outlines of all obstacles.
        reach_m: largest gap between skin and obstacle that still counts as a contact.
        friction: friction coefficient mu between body and obstacles.

    Returns:
        The contacts, each with its place on the skin, its direction of push, and its gap.
    """
    samples, nearest_w, distances_m = nearest_on_chain(nodes_w.T, outlines)
    near_obstacles = np.flatnonzero(distances_m - radius_m < reach_m)
    center_w = nearest_w[near_obstacles]  # (k, 2) on the center line
    link, fraction_index = np.divmod(samples[near_obstacles], len(LINK_FRACTIONS))

    # Normal, tangent and arc length of each contact.
    link_vectors_w = np.diff(nodes_w, axis=1).T  # (n_links, 2)
    lengths_m = np.hypot(*link_vectors_w.T)
    distance_m, normal = outlines.distance_and_normal(center_w, near_obstacles)
    tangent = (link_vectors_w / lengths_m[:, None])[link]
    link_start_m = np.concatenate(([0.0], np.cumsum(lengths_m)[:-1]))
    body_s_m = link_start_m[link] + LINK_FRACTIONS[fraction_index] * lengths_m[link]

    # Sliding friction acts on the body against its motion along the tangent.
    direction = normal - friction * tangent

    # An obstacle in front of the head or behind the tail, whose normal is along the body, cannot be pushed sideways.
    normal_along_body = np.abs(np.einsum("ij,ij->i", normal, tangent))
    beside_body = np.flatnonzero(normal_along_body < MAX_NORMAL_ALONG_BODY)
    return Touches(
        obstacle=near_obstacles[beside_body],
        places_w=(center_w - radius_m * normal)[beside_body],
        directions_w=direction[beside_body],
        tangents_w=tangent[beside_body],
        body_s_m=body_s_m[beside_body],
        gap_m=(distance_m - radius_m)[beside_body],
    )


def push_forward(
    nodes_w: Floats,
    touches: Touches,
    turns_per_m: Floats,
    *,
    contact_gap_scale_m: float,
    extra_cost: Floats | float = 0.0,
) -> UnitPush:
    """Solve for the contact forces and joint torques that push with 1 N along the body.

    Minimizes, over lambda >= 0 and with W = diag(1 + gap_c / contact_gap_scale_m + extra_cost_c),

        |BALANCE_WEIGHT (A lambda - b)|^2 + sum_i (WORK_WEIGHT theta_i' tau_i)^2 + |FORCE_WEIGHT W lambda|^2

    where A lambda = b is the balance of forces and moments, and tau = lever lambda + drag_torque. Moments are taken
    about the center of the body.

    Args:
        nodes_w: (2, n) m, nodes of the body's center line, tail to head.
        touches: k contacts.
        turns_per_m: (n_joints,) theta_i' in rad/m, of the joints that bend.
        contact_gap_scale_m: gap at which the force of a contact costs twice as much as without a gap.
        extra_cost: (k,) added to the cost weights of the contacts.
    """
    rear_w = nodes_w[:, :-1].T  # (n_links, 2)
    run_w = np.diff(nodes_w, axis=1).T
    lengths_m = np.hypot(*run_w.T)
    middles_w = rear_w + 0.5 * run_w
    tangents = run_w / lengths_m[:, None]
    length_fraction = lengths_m / lengths_m.sum()  # the drag of each link, for 1 N in sum
    center_w = length_fraction @ middles_w

    drag_force = length_fraction @ tangents
    drag_moment = length_fraction @ cross(middles_w - center_w, tangents)
    b = np.array([*drag_force, drag_moment])  # (3,)
    arms_m = touches.places_w - center_w
    a = np.column_stack([touches.directions_w, cross(arms_m, touches.directions_w)]).T  # (3, k)

    joints_w = nodes_w[:, 1:-1].T  # (n_joints, 2), p_i
    is_ahead = touches.body_s_m[None, :] > np.cumsum(lengths_m)[:-1, None]
    lever = -(is_ahead * cross(touches.places_w[None] - joints_w[:, None], touches.directions_w[None]))
    link_is_ahead = np.triu(np.ones((len(joints_w), len(lengths_m)), dtype=bool), 1)
    drag_torque = (link_is_ahead * cross(middles_w[None] - joints_w[:, None], tangents[None])) @ length_fraction

    # Solve for x = W lambda, so that the last part of the cost is that of a unit matrix.
    weight = 1.0 + np.maximum(touches.gap_m, 0.0) / contact_gap_scale_m + extra_cost
    work_cost = WORK_WEIGHT * np.abs(turns_per_m)
    rows = [
        BALANCE_WEIGHT * a / weight,
        work_cost[:, None] * lever / weight,
        FORCE_WEIGHT * np.eye(len(touches)),
    ]
    right = [BALANCE_WEIGHT * b, -work_cost * drag_torque, np.zeros(len(touches))]
    lambdas = _solve_nonnegative(np.vstack(rows), np.concatenate(right)) / weight
    return UnitPush(
        lambdas=lambdas,
        torques_nm=lever @ lambdas + drag_torque,
        residual=float(np.linalg.norm(a @ lambdas - b)),
    )


def _solve_nonnegative(matrix: Floats, right_side: Floats) -> Floats:
    """Return the x >= 0 that minimizes |matrix x - right|.

    Source: the active-set algorithm NNLS of Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23.

    Args:
        matrix: (m, k).
        right: (m,) right side.

    Returns:
        (k,) solution.
    """
    count = matrix.shape[1]
    x = np.zeros(count)
    free = np.zeros(count, dtype=bool)  # variables that may be above 0
    if count == 0:
        return x
    for _ in range(MAX_ITERATIONS):
        gradient = matrix.T @ (right_side - matrix @ x)
        gradient[free] = -np.inf
        entering = int(np.argmax(gradient))
        if gradient[entering] < MIN_GRADIENT:
            break
        free[entering] = True
        x = _solve_free(matrix, right_side, x, free)
    return x


def _solve_free(matrix: Floats, right: Floats, x: Floats, free: NDArray[np.bool_]) -> Floats:
    """Solve for the free variables, and bind those that would become negative; `free` is changed in place."""
    while True:
        trial = np.zeros(len(x))
        trial[free] = np.linalg.lstsq(matrix[:, free], right, rcond=None)[0]
        if (trial[free] > 0).all():
            return trial
        # Go towards the trial until the first variable reaches 0.
        negative = free & (trial <= 0)
        step = float(np.min(x[negative] / np.maximum(x[negative] - trial[negative], 1e-12)))
        x = x + step * (trial - x)
        free &= x > 1e-12
        if not free.any():
            return np.zeros(len(x))

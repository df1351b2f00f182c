"""Which forces on the obstacles push a body forward, and the joint torques that hold them. Pure.

The body lies between obstacles; contact c can push it with lambda_c >= 0 along `d_c = n_c - mu t_c`. The forces that
push with F along the body, and the torque of each joint i that goes with them:

    sum_c lambda_c [d_c ; o_c x d_c] = (F/L) integral [t ; gamma x t] d sigma
    tau_i = - sum_{c ahead of i} lambda_c (o_c - p_i) x d_c + (F/L) integral_{ahead of i} (gamma - p_i) x t d sigma

Sliding on by ds, joint i turns by theta_i' ds, so of the work F ds = sum tau_i theta_i' ds some joints may do more than
all of it and others take it out again. Of all such forces those of least squares of tau_i theta_i' are taken, and then
the smallest; a contact's weight grows with its gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import cross
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import SHARES, Outlines, nearest_on_chain

BUMP = 0.6  # |n.t| of a contact: beyond, something stands before the head
BALANCED = 0.05  # share of the force that is left over
MAX_STEPS = 30
BALANCE, THRIFT, SMALL = 10.0, 0.05, 0.02  # weights of: the balance of forces, tau_i theta_i', the size of the forces


@dataclass(frozen=True)
class Touches:
    """Where a body touches obstacles, or nearly; arrays with one row a contact."""

    obstacle: NDArray[np.intp]
    places_w: Floats  # (k, 2) on the body's surface
    directions_w: Floats  # (k, 2) of the push, friction included
    tangents_w: Floats  # (k, 2) along the body, towards the head
    body_s_m: Floats  # (k,) arc length from the tail end
    gap_m: Floats  # (k,)

    def __len__(self) -> int:
        return len(self.gap_m)


@dataclass(frozen=True)
class Push:
    """Forces for 1 N along the body."""

    lambdas: Floats  # (k,)
    torques_nm: Floats  # (n_joints,), of the joints that bend
    rest: float  # of the 1 N: what no contact can balance

    @property
    def balanced(self) -> bool:
        """Whether these contacts can push at all."""
        return self.rest < BALANCED and bool((self.lambdas > 0.0).any())


class PushFilter:
    """A low-pass of pushes: noise of the pose moves much force from one contact to another at every look."""

    def __init__(self, filter_s: float) -> None:
        self._filter_s = filter_s
        self._time_s, self._lambdas, self._rest = -np.inf, dict[str, float](), 0.0
        self._torques_nm: Floats | float = 0.0

    def take(self, time_s: float, push: Push, obstacles: Sequence[str]) -> Push:
        """The filtered push. obstacles: of its contacts."""
        kept = float(np.exp((self._time_s - time_s) / self._filter_s))
        was, new = self._lambdas, 1.0 - kept
        lambdas = [new * now + kept * was.get(name, 0.0) for name, now in zip(obstacles, push.lambdas, strict=True)]
        torques_nm, rest = new * push.torques_nm + kept * self._torques_nm, new * push.rest + kept * self._rest
        self._time_s, self._lambdas = time_s, dict(zip(obstacles, lambdas, strict=True))
        self._torques_nm, self._rest = torques_nm, rest
        return Push(np.array(lambdas), torques_nm, rest)


def find_touches(nodes_w: Floats, radius_m: float, outlines: Outlines, *, reach_m: float, friction: float) -> Touches:
    """Contacts of a chain with nodes (2, n): for each obstacle within reach the point of the body nearest to it."""
    number, nearest, distances = nearest_on_chain(nodes_w.T, outlines)
    which = np.flatnonzero(distances - radius_m < reach_m)
    at, (link, share) = nearest[which], np.divmod(number[which], len(SHARES))
    run = np.diff(nodes_w, axis=1).T
    lengths = np.hypot(*run.T)
    distance, normal = outlines.towards(at, which)
    tangent = (run / lengths[:, None])[link]
    keep = np.flatnonzero(np.abs(np.einsum("ij,ij->i", normal, tangent)) < BUMP)
    body_s_m = np.concatenate(([0.0], np.cumsum(lengths)[:-1]))[link] + SHARES[share] * lengths[link]
    direction = normal - friction * tangent
    return Touches(
        which[keep],
        (at - radius_m * normal)[keep],
        direction[keep],
        tangent[keep],
        body_s_m[keep],
        (distance - radius_m)[keep],
    )


def push_forward(
    nodes_w: Floats, touches: Touches, turns_per_m: Floats, *, contact_gap_scale_m: float, dearer: Floats | float = 0.0
) -> Push:
    """Forces and torques for 1 N along the chain.

    turns_per_m: (n_joints,) theta_i', rad per metre of the way, of the joints that bend. contact_gap_scale_m: a gap
    that makes a contact count half. dearer: (k,) by how many times more than its size a contact's force counts, beside
    that.
    """
    rear, run = nodes_w[:, :-1].T, np.diff(nodes_w, axis=1).T
    lengths = np.hypot(*run.T)
    middles, tangents = rear + 0.5 * run, run / lengths[:, None]
    share = lengths / lengths.sum()
    center = share @ middles
    drag = np.array([*(share @ tangents), share @ cross(middles - center, tangents)])
    arms = touches.places_w - center
    matrix = np.column_stack([touches.directions_w, cross(arms, touches.directions_w)]).T
    joints = nodes_w[:, 1:-1].T
    ahead = touches.body_s_m[None, :] > np.cumsum(lengths)[:-1, None]
    lever = -(ahead * cross(touches.places_w[None] - joints[:, None], touches.directions_w[None]))
    later = np.triu(np.ones((len(joints), len(lengths)), dtype=bool), 1)
    braked = (later * cross(middles[None] - joints[:, None], tangents[None])) @ share
    weight = 1.0 + np.maximum(touches.gap_m, 0.0) / contact_gap_scale_m + dearer
    costs = THRIFT * np.abs(turns_per_m)
    full = np.vstack([BALANCE * matrix / weight, costs[:, None] * lever / weight, SMALL * np.eye(len(touches))])
    lambdas = _least_squares(full, np.concatenate([BALANCE * drag, -costs * braked, np.zeros(len(touches))])) / weight
    return Push(lambdas, lever @ lambdas + braked, float(np.linalg.norm(matrix @ lambdas - drag)))


def _least_squares(full: Floats, right: Floats) -> Floats:
    """The x >= 0 with the least |full x - right|, by active sets (Lawson and Hanson)."""
    count = full.shape[1]
    x, used = np.zeros(count), np.zeros(count, dtype=bool)
    if count == 0:
        return x
    for _ in range(MAX_STEPS):
        gradient = full.T @ (right - full @ x)
        gradient[used] = -np.inf
        enters = int(np.argmax(gradient))
        if gradient[enters] < 1e-9:
            break
        used[enters] = True
        while True:
            trial = np.zeros(count)
            trial[used] = np.linalg.lstsq(full[:, used], right, rcond=None)[0]
            if (trial[used] > 0).all():
                x = trial
                break
            low = used & (trial <= 0)
            step = float(np.min(x[low] / np.maximum(x[low] - trial[low], 1e-12)))
            x = x + step * (trial - x)
            used &= x > 1e-12
            if not used.any():
                x = np.zeros(count)
                break
    return x

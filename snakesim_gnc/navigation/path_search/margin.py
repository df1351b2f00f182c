"""The propulsion margin: how hard a body can push itself along its own curve with the contacts that it has. Pure.

Sliding forward, contact c pushes with the force lambda_c >= 0 along `d_c = n_c - mu t_c`: its normal, less friction on
the obstacle. The contacts push a body of length L forward along its curve gamma with force F if

    sum_c lambda_c [d_c ; o_c x d_c] = F (1/L) integral [t ; gamma x t] d sigma,   0 <= lambda_c <= lambda_max

o_c is the place of contact c, t the unit tangent of the curve. The margin F* is the largest such F. The search for it
goes through all sets of three contacts, because three equations have a basic solution with three unknowns. More
contacts could share the load, so the result is a lower bound. See `docs/concepts/path-planning.md`.
"""

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

MAX_CONTACT_FORCE_N = 80.0  # lambda_max
# Of three unit wrenches with scaled moments; smaller ones cannot balance every load.
MIN_DETERMINANT = 1e-4
# Moments count over half a meter, so that they are of the order of the forces.
WRENCH_SCALE = 1.0, 1.0, 2.0
MIN_FORCE_PER_N = 1e-9  # avoids a division by zero


def compute_margins_n(contacts: Floats, drag: Floats) -> Floats:
    """Compute the propulsion margin F* of n bodies.

    Args:
        contacts: (n, k, 3) wrenches [d_c ; o_c x d_c] of unit pushes, zero where a body has fewer than k contacts.
        drag: (n, 3) wrench of the drag for F = 1 N, which is the right-hand side of the balance. All moments are about
            one point near the bodies.

    Returns:
        (n,) margins in N; 0 where no three contacts can push.
    """
    margins_n = np.zeros(len(contacts))
    is_contact: NDArray[np.bool_] = np.any(contacts != 0.0, axis=2)
    contact_count = is_contact.sum(axis=1)
    # Most bodies have far fewer than k contacts, so those with the same number are computed together.
    for count in range(3, contacts.shape[1] + 1):
        rows = np.flatnonzero(contact_count == count)
        if len(rows):
            packed_contacts = contacts[rows][is_contact[rows]].reshape(-1, count, 3)
            margins_n[rows] = _compute_margins_with_all_contacts_n(packed_contacts, drag[rows])
    return margins_n


def _compute_margins_with_all_contacts_n(contacts: Floats, drag: Floats) -> Floats:
    """Return the propulsion margins of n bodies that all have k contacts.

    The margin is the largest force along the body that any three contacts can balance within the limit of contact
    forces. Cramer's rule gives the forces of three contacts a, b, c under the drag d, with V = a . (b x c):

        lambda_a = d . (b x c) / V,   lambda_b = -c . (d x a) / V,   lambda_c = b . (d x a) / V

    Args:
        contacts: (n, k, 3) wrenches of a unit push at each contact.
        drag: (n, 3) wrench of the ground's drag on each body.

    Returns:
        (n,) margins in N; 0 if no three contacts can push.
    """
    scaled = contacts * WRENCH_SCALE
    scaled_drag = drag * WRENCH_SCALE
    first, second, third = _list_contact_triples(contacts.shape[1])
    a = scaled[:, first].transpose(2, 0, 1)  # (3, n, sets)
    b = scaled[:, second].transpose(2, 0, 1)
    c = scaled[:, third].transpose(2, 0, 1)
    d = scaled_drag.T[:, :, None]  # (3, n, 1)
    b_cross_c = _cross(b, c)
    d_cross_a = _cross(d, a)
    volume = _dot(a, b_cross_c)
    is_regular = np.abs(volume) > MIN_DETERMINANT
    inverse_volume = 1.0 / np.where(is_regular, volume, 1.0)
    forces = np.stack(
        [
            _dot(d, b_cross_c) * inverse_volume,
            -_dot(c, d_cross_a) * inverse_volume,
            _dot(b, d_cross_a) * inverse_volume,
        ]
    )
    can_push = is_regular & (forces.min(axis=0) >= 0.0)
    max_force = np.maximum(forces.max(axis=0), MIN_FORCE_PER_N)
    return MAX_CONTACT_FORCE_N / np.where(can_push, max_force, np.inf).min(axis=1)


@cache
def _list_contact_triples(count: int) -> tuple[NDArray[np.intp], ...]:
    """Return the indices of the first, second and third contact of all sets of three out of `count` contacts."""
    indices = np.array(list(combinations(range(count), 3)), dtype=np.intp).reshape(-1, 3)
    return indices[:, 0], indices[:, 1], indices[:, 2]


def _cross(a: Floats, b: Floats) -> Floats:
    """Return a x b of vectors whose components are the first axis."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

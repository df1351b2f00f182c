"""The propulsion margin: how hard a body can push itself along its own curve with the contacts that it has. Pure.

Sliding forward, contact c pushes with lambda_c >= 0 along `d_c = n_c - mu t_c` (its normal, less friction on the
obstacle). The contacts push a body of length L forward along its curve gamma with force F when

    sum_c lambda_c [d_c ; o_c x d_c] = F (1/L) integral [t ; gamma x t] d sigma,   0 <= lambda_c <= lambda_max

and the margin F* is the greatest such F. It is sought among all threes of contacts: three equations have a basic
solution with three unknowns. More contacts could share the load, so this is a lower bound. See `docs/poal.md`.
"""

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

LARGEST_N = 80.0  # lambda_max: force on one contact
SINGULAR = 1e-4  # of a determinant of three unit wrenches, with moments over half a metre


@cache
def _threes(count: int) -> tuple[NDArray[np.intp], ...]:
    indices = np.array(list(combinations(range(count), 3)), dtype=np.intp).reshape(-1, 3)
    return indices[:, 0], indices[:, 1], indices[:, 2]


def margins_n(contacts: Floats, drag: Floats) -> Floats:
    """F* of n bodies, (n,); zero where no three contacts can push.

    contacts: (n, k, 3) wrenches of the contacts' unit pushes, zero where a body has fewer; drag: (n, 3) mean wrench of
    the tangent, the right-hand side for 1 N. All moments about one point near the bodies.
    """
    margins = np.zeros(len(contacts))
    there: NDArray[np.bool_] = np.any(contacts != 0.0, axis=2)
    has = there.sum(axis=1)
    for count in range(3, contacts.shape[1] + 1):  # most have far fewer than k: those of equal number together
        rows = np.flatnonzero(has == count)
        if len(rows):
            margins[rows] = _of_as_many(contacts[rows][there[rows]].reshape(-1, count, 3), drag[rows])
    return margins


def _of_as_many(contacts: Floats, drag: Floats) -> Floats:
    """The same for bodies that all have k contacts."""
    first, second, third = _threes(contacts.shape[1])
    scaled = contacts * (1.0, 1.0, 2.0)  # moments over half a metre
    wanted = drag * (1.0, 1.0, 2.0)
    a, b, c = (scaled[:, k].transpose(2, 0, 1) for k in (first, second, third))
    d = wanted.T[:, :, None]
    cross_bc = _cross(b, c)
    volume = _dot(a, cross_bc)
    regular = np.abs(volume) > SINGULAR
    inverse = 1.0 / np.where(regular, volume, 1.0)
    cross_da = _cross(d, a)
    forces = np.stack([_dot(d, cross_bc) * inverse, -_dot(c, cross_da) * inverse, _dot(b, cross_da) * inverse])
    pushes = regular & (forces.min(axis=0) >= 0.0)
    return LARGEST_N / np.where(pushes, np.maximum(forces.max(axis=0), 1e-9), np.inf).min(axis=1)


def _cross(a: Floats, b: Floats) -> Floats:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Floats, b: Floats) -> Floats:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

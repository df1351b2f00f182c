"""Whether obstacles hold a body whose joints are stiff: first-order form closure in the plane, without friction.

A contact at o with normal n allows the twists x for which w . x >= 0, where w = [n ; o x n / l] is its wrench. Contacts
close the form if they allow no twist at all. If they allow some, they also allow one with w . x = 0 at two contacts: a
rotation about the pole at which the normals of both meet, x = w_i x w_j. So it is enough to test these twists, one for
each pair of contacts. The margin is the minimum over all pairs of -(max_k w_k . x)(min_k w_k . x) with unit x.
The form is closed if the margin is above 0.
"""

from itertools import combinations

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines, nearest_on_chain

MAX_GAP_M = 0.02  # an obstacle this near to the body counts as a contact
SINGULAR = 1e-6  # |x| of two contacts whose normals are on one line


def contacts_beside(nodes_w: Floats, radius_m: float, outlines: Outlines) -> tuple[Floats, Floats]:
    """Return the places and normals, both (k, 2), of the obstacles beside a body, each where it is nearest.

    Args:
        nodes_w: (n, 2) nodes of the chain.
        radius_m: Radius of its links.
        outlines: The obstacles.
    """
    _, nearest, distances = nearest_on_chain(nodes_w, outlines)
    which = np.flatnonzero(distances - radius_m < MAX_GAP_M)
    at = nearest[which]
    _, normals = outlines.distance_and_normal(at, which)
    return at - radius_m * normals, normals


def form_closure_margin(places_w: Floats, normals_w: Floats, length_m: float) -> float:
    """Return how well frictionless contacts hold a planar body in form closure.

    Each contact blocks the planar twists x with w_k . x < 0, where w_k = (normal, moment / length) is its wrench. A
    twist that is perpendicular to two wrenches is a candidate for an escape. The contacts close the form if, for every
    such twist, some contact has a positive product and some contact a negative one. The margin is the minimum over
    these twists, scaled to length 1, of -(max_k w_k . x) * (min_k w_k . x).

    Args:
        places_w: (k, 2) places of the contacts, in m.
        normals_w: (k, 2) unit normals at the contacts.
        length_m: Length by which moments are divided, so that all components of a wrench have one unit.

    Returns:
        The margin, without unit and at most 1; the form is closed if it is positive. It is 0 for fewer than four
        contacts, which cannot close the form.
    """
    if len(places_w) < 4:
        return 0.0
    arms = (places_w - places_w.mean(axis=0)) / length_m
    moments = arms[:, 0] * normals_w[:, 1] - arms[:, 1] * normals_w[:, 0]
    wrenches = np.column_stack([normals_w, moments])  # (k, 3)

    contact_pairs = np.array(list(combinations(range(len(wrenches)), 2)))
    first, second = contact_pairs.T
    twists = np.cross(wrenches[first], wrenches[second])  # (pairs, 3)
    sizes = np.linalg.norm(twists, axis=1)
    is_regular = sizes > SINGULAR
    unit_twists = twists[is_regular] / sizes[is_regular, None]

    products = unit_twists @ wrenches.T  # w_k . x, (pairs, k)
    # The twist of a pair is perpendicular to both of its wrenches: remove the rounding error.
    products[np.abs(products) < SINGULAR] = 0.0
    if not len(products):
        return 0.0
    margins = -products.max(axis=1) * products.min(axis=1)
    return float(np.min(margins))

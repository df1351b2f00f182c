"""Tests whether obstacles hold a stiff body: first-order form closure in the plane, without friction.

A contact at o with normal n allows the twists x for which w . x >= 0, where w = [n ; o x n / l] is its wrench. Contacts
close the form if they allow no twist at all. If they allow some, they also allow one with w . x = 0 at two contacts: a
rotation about the pole at which the normals of both meet, x = w_i x w_j. So it is enough to test these twists, one for
each pair of contacts. The margin is the minimum over all pairs of -(max_k w_k . x)(min_k w_k . x) with unit x.
The form is closed if the margin is above 0.
"""

from itertools import combinations

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines, find_nearest_points_on_chain

MAX_GAP_M = 0.02  # an obstacle at most this far from the body counts as a contact
SINGULARITY_TOLERANCE = 1e-6  # norm of the twist of two contacts whose normals are on one line


def find_body_contacts(
    body_points_w: Floats, radius_m: float, outlines: ObstacleOutlines
) -> tuple[Floats, Floats]:
    """Find the contacts of a body with the obstacles beside it: for each obstacle the point nearest to the body.

    Args:
        body_points_w: (n, 2) tail end, joints and head end, in m.
        radius_m: Radius of the links.
        outlines: Outlines of the obstacles.

    Returns:
        contact_points_w: (k, 2) contact points on the obstacles, in m.
        normals_w: (k, 2) outward unit normals of the obstacles there.
    """
    _, nearest, distances = find_nearest_points_on_chain(body_points_w, outlines)
    touched_indices = np.flatnonzero(distances - radius_m < MAX_GAP_M)
    axis_points_w = nearest[touched_indices]
    _, normals = outlines.compute_distances_and_normals(axis_points_w, touched_indices)
    return axis_points_w - radius_m * normals, normals


def compute_form_closure_margin(
    contact_points_w: Floats, normals_w: Floats, length_m: float
) -> float:
    """Compute how well frictionless contacts hold a planar body in form closure.

    Each contact blocks the planar twists x with w_k . x < 0, where w_k = (normal, moment / length) is its wrench. A
    twist that is perpendicular to two wrenches is a candidate for an escape. The contacts close the form if, for every
    such twist, some contact has a positive product and some contact a negative one. The margin is the minimum over
    these twists, scaled to length 1, of -(max_k w_k . x) * (min_k w_k . x).

    Args:
        contact_points_w: (k, 2) positions of the contacts, in m.
        normals_w: (k, 2) unit normals at the contacts.
        length_m: Length by which moments are divided, so that all components of a wrench have one unit.

    Returns:
        The margin, dimensionless and at most 1. The body is held if it is positive. It is 0 for fewer than four
        contacts, which cannot close the form.
    """
    if len(contact_points_w) < 4:
        return 0.0
    arms = (contact_points_w - contact_points_w.mean(axis=0)) / length_m
    moments = arms[:, 0] * normals_w[:, 1] - arms[:, 1] * normals_w[:, 0]
    wrenches = np.column_stack([normals_w, moments])  # (k, 3)

    contact_pairs = np.array(list(combinations(range(len(wrenches)), 2)))
    first, second = contact_pairs.T
    twists = np.cross(wrenches[first], wrenches[second])  # (pairs, 3)
    norms = np.linalg.norm(twists, axis=1)
    is_regular = norms > SINGULARITY_TOLERANCE
    unit_twists = twists[is_regular] / norms[is_regular, None]

    products = unit_twists @ wrenches.T  # w_k . x, (pairs, k)
    # The twist of a pair is perpendicular to both of its wrenches: remove the rounding error.
    products[np.abs(products) < SINGULARITY_TOLERANCE] = 0.0
    if not len(products):
        return 0.0
    margins = -products.max(axis=1) * products.min(axis=1)
    return float(np.min(margins))

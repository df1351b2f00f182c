"""Whether obstacles hold a body whose joints hold: first-order form closure, in the plane, without friction. Pure.

A contact with place o and normal n allows the twists x for which w.x >= 0, with w = [n ; o x n / l]. Contacts close
the form when they allow no twist at all. Where they allow some, then also one that leaves two of them alone, as a turn
about the pole in which their normals meet: x = w_i x w_j. So for each pair the others are asked which way they let the
body turn about its pole; the margin is the least, over all pairs, of -(max w_k.x)(min w_k.x), with unit x. Above 0 is
closed.
"""

from itertools import combinations

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines, nearest_on_chain

REACH_M = 0.02  # an obstacle so near to the body counts
SINGULAR = 1e-6  # |x| of two contacts whose normals are on one line


def contacts_beside(nodes_w: Floats, radius_m: float, outlines: Outlines) -> tuple[Floats, Floats]:
    """Places and normals (k, 2) of the obstacles beside a chain with nodes (n, 2): each where it is nearest."""
    _, nearest, distances = nearest_on_chain(nodes_w, outlines)
    which = np.flatnonzero(distances - radius_m < REACH_M)
    at = nearest[which]
    _, normals = outlines.towards(at, which)
    return at - radius_m * normals, normals


def form_closure_margin(places_w: Floats, normals_w: Floats, length_m: float) -> float:
    """Without unit, at most 1, of contacts (k, 2); 0: fewer than four, which close nothing. length_m: l, of moments."""
    if len(places_w) < 4:
        return 0.0
    arms = (places_w - places_w.mean(axis=0)) / length_m
    wrenches = np.column_stack([normals_w, arms[:, 0] * normals_w[:, 1] - arms[:, 1] * normals_w[:, 0]])
    first, second = np.array(list(combinations(range(len(wrenches)), 2))).T
    twists = np.cross(wrenches[first], wrenches[second])
    sizes = np.linalg.norm(twists, axis=1)
    turns = (twists[sizes > SINGULAR] / sizes[sizes > SINGULAR, None]) @ wrenches.T
    turns[np.abs(turns) < SINGULAR] = 0.0  # the pair's own
    return float(np.min(-turns.max(axis=1) * turns.min(axis=1))) if len(turns) else 0.0

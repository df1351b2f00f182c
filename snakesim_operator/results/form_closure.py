"""How well contacts hold a body whose joints hold: the margin of first-order form closure, in the plane. Pure.

A contact with place o and normal n allows the twists x for which w.x >= 0, with w = [n ; o x n / l]. Contacts close
the form when they allow no twist at all. Where they allow some, then also one that leaves two of them alone, as a turn
about the pole in which their normals meet: x = w_i x w_j. So for each pair the others are asked which way they let the
body turn about its pole; the margin is the least, over all pairs, of -(max w_k.x)(min w_k.x), with unit x. Above 0 is
closed.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from snakesim_hal.wire.messages import WorldContact

SINGULAR = 1e-6  # |x| of two contacts whose normals are on one line


def form_closure_margin(contacts: Sequence[WorldContact], length_m: float) -> float:
    """Without unit, between -1 and 1; 0: fewer than four contacts, which cannot close it. length_m: l, of moments."""
    if len(contacts) < 4:
        return 0.0
    places = np.array([contact.position_w[:2] for contact in contacts])
    normals = np.array([contact.normal_w[:2] for contact in contacts])
    arms = (places - places.mean(axis=0)) / length_m
    wrenches = np.column_stack([normals, arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]])
    first, second = np.array(list(combinations(range(len(contacts)), 2))).T
    twists = np.cross(wrenches[first], wrenches[second])
    sizes = np.hypot(np.hypot(*twists[:, :2].T), twists[:, 2])
    turns = (twists[sizes > SINGULAR] / sizes[sizes > SINGULAR, None]) @ wrenches.T
    turns[np.abs(turns) < SINGULAR] = 0.0  # the pair's own
    return float(np.min(-turns.max(axis=1) * turns.min(axis=1), initial=1.0)) if len(turns) else 0.0

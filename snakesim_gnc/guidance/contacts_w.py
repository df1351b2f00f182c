"""Contacts of the links, transformed into the world. Pure."""

from collections.abc import Callable

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Contact, WorldContact


def contact_w(
    contact: Contact, origins_w: Floats, rotations: Floats, rear_s_m: Floats, named: Callable[[Floats], str | None]
) -> WorldContact:
    """origins_w (n, 3), rotations (n, 3, 3), rear_s_m (n,) arc length of rears; named: what is at a place."""
    rotation = rotations[contact.link]
    local = np.array([contact.position_l, contact.normal_l, contact.tangent_1_l, contact.force_l])
    position, normal, tangent, force = local @ rotation.T
    position = position + origins_w[contact.link]
    return WorldContact(
        link=contact.link,
        obstacle=named(position),
        body_s_m=float(rear_s_m[contact.link]) + contact.position_l[0],
        position_w=tuple(position.tolist()),
        normal_w=tuple(normal.tolist()),
        tangent_w=tuple(tangent.tolist()),
        force_w=tuple(force.tolist()),
    )

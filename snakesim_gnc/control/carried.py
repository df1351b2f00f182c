"""What measured contacts do to a body that stands: whether they push it on, or hold it back. Pure.

Of a body that stands, all forces are in balance: what its contacts push it on with in sum, the ground's friction takes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import World

HELD_SHARE = 0.5  # of the push: contacts that hold a body back with more than that jam it


@dataclass(frozen=True)
class Carried:
    """Measured contact forces on the body, counted along a direction."""

    strongest_n: float  # 0: nothing touches the body
    ahead_n: float  # sum of those that push it on
    back_n: float  # sum of those that hold it back, positive
    holder: str  # the obstacle that holds it back most
    touched: frozenset[str | None]


def measured(world: World, direction_w: Sequence[float]) -> Carried | None:
    """The contacts of a world model; None when no sensor tells. direction_w: (2,) of any length."""
    if world.contacts_stamp_ns is None:
        return None
    size = math.hypot(*direction_w)
    along = [
        (contact.force_w[0] * direction_w[0] + contact.force_w[1] * direction_w[1]) / size for contact in world.contacts
    ]
    least = min(range(len(along)), key=lambda i: along[i], default=None)
    return Carried(
        strongest_n=max((math.hypot(*contact.force_w) for contact in world.contacts), default=0.0),
        ahead_n=math.fsum(force for force in along if force > 0.0),
        back_n=-math.fsum(force for force in along if force < 0.0),
        holder="" if least is None else world.contacts[least].obstacle or "an obstacle without a name",
        touched=frozenset(contact.obstacle for contact in world.contacts),
    )


def what_holds(force_n: float, carried: Carried | None, push_points: Sequence[str]) -> tuple[bool, str]:
    """Whether a body that stands is jammed, and why it stands, as far as its contacts show it.

    force_n: propulsion that is commanded. push_points: names of the obstacles that are to carry it.
    """
    pushing = f"standing still with {force_n:.1f} N of propulsion"
    if carried is None:
        return False, f"{pushing}; what holds it is unknown without a sensor of contacts"
    if carried.strongest_n == 0.0:
        return False, f"{pushing}, and no obstacle touches the body, so there is nothing to push off"
    if carried.back_n > HELD_SHARE * max(carried.ahead_n, force_n):
        forces = f"push it on with {carried.ahead_n:.0f} N and hold it back with {carried.back_n:.0f} N"
        return True, f"jammed: {pushing}; obstacles {forces}, {carried.holder} most"
    missing = [name for name in push_points if name not in carried.touched]
    lacks = f" (no contact at {', '.join(missing)})" if missing else ""
    net_n = max(carried.ahead_n - carried.back_n, 0.0)
    return (
        False,
        f"{pushing}; contacts push it on with {net_n:.1f} N{lacks}, too little against the friction of the ground",
    )

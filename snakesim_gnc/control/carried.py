"""What measured contacts do to a body that stands: whether they push it on, or hold it back.

Of a body that stands, all forces are in balance: what its contacts push it on with in sum, the ground's friction takes.
Forces are means over the last 50 ms: those of one instant depend on how hard the surfaces are (`measured_force`).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.measured_force import FELT_OVER_S
from snakesim_hal.wire.messages import World, WorldContact

HELD_SHARE = 0.5  # of the push: contacts that hold a body back with more than that jam it


@dataclass(frozen=True)
class NetContactForce:
    """Measured contact forces on the body, counted along a direction."""

    strongest_n: float  # 0: nothing touches the body
    ahead_n: float  # sum of those that push it on
    back_n: float  # sum of those that hold it back, positive
    holder: str  # the obstacle that holds it back most
    touched: frozenset[str | None]


class FeltContacts:
    """The contacts of the newest world models."""

    def __init__(self) -> None:
        self._last: deque[tuple[int, Sequence[WorldContact]]] = deque()  # with the stamp of the sensor

    def take(self, world: World) -> None:
        """A newer world model, or again the last one. Estimated contacts tell where the body touches, not how hard."""
        timestamp_ns = world.contacts_timestamp_ns
        if timestamp_ns is None or world.contacts_from == "joint_torques":
            self._last.clear()
            return
        if self._last and timestamp_ns == self._last[-1][0]:
            return
        self._last.append((timestamp_ns, world.contacts))
        while not 0 <= timestamp_ns - self._last[0][0] < round(FELT_OVER_S * 1e9):
            self._last.popleft()

    def at(self, obstacles: Sequence[str | None]) -> list[float | None]:
        """How hard each obstacle pushes the body, 0 where none is felt; empty when no sensor tells."""
        forces = self.forces_w(obstacles)
        return [None if name is None else math.hypot(*force) for name, force in zip(obstacles, forces, strict=False)]

    def forces_w(self, obstacles: Sequence[str | None]) -> list[tuple[float, float]]:
        """With which horizontal force each obstacle pushes the body; empty when no sensor tells."""
        if not self._last:
            return []
        sums: dict[str | None, tuple[float, float]] = {}
        for _, contacts in self._last:
            for contact in contacts:
                x, y = sums.get(contact.obstacle, (0.0, 0.0))
                sums[contact.obstacle] = (x + contact.force_w[0], y + contact.force_w[1])
        count, sizes = len(self._last), [sums.get(name, (0.0, 0.0)) for name in obstacles]
        return [(x / count, y / count) for x, y in sizes]

    def along(self, direction_w: Sequence[float]) -> NetContactForce | None:
        """What they do along a direction, (2,) of any length; None when no sensor tells."""
        if not self._last:
            return None
        share, size = 1.0 / len(self._last), math.hypot(*direction_w)
        along: dict[tuple[int, str | None], float] = {}
        strength: dict[tuple[int, str | None], float] = {}
        for _, contacts in self._last:
            for contact in contacts:
                at, force = (contact.link, contact.obstacle), contact.force_w
                ahead_n = (force[0] * direction_w[0] + force[1] * direction_w[1]) / size
                along[at] = along.get(at, 0.0) + share * ahead_n
                strength[at] = strength.get(at, 0.0) + share * math.hypot(*force)
        holder = min(along, key=lambda at: along[at], default=None)
        return NetContactForce(
            strongest_n=max(strength.values(), default=0.0),
            ahead_n=math.fsum(force for force in along.values() if force > 0.0),
            back_n=-math.fsum(force for force in along.values() if force < 0.0),
            holder="" if holder is None else holder[1] or "an obstacle without a name",
            touched=frozenset(obstacle for _, obstacle in along),
        )


def what_holds(force_n: float, carried: NetContactForce | None, push_points: Sequence[str]) -> tuple[bool, str]:
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

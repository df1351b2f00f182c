"""The net force of the measured contacts on a body, and why a body does not move.

All forces on a stationary body are in balance: the ground friction takes up the sum of the contact forces.
Forces are means over FORCE_MEAN_S, because the force of one moment depends on how hard the surfaces are
(see `measured_force`).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.measured_force import FORCE_WINDOW_S
from snakesim_hal.wire.messages import World, WorldContact

JAM_FORCE_RATIO = 0.5  # contacts that push backward with more than this ratio of the forward push jam the body


@dataclass(frozen=True)
class NetContactForce:
    """Measured contact forces on the body, resolved along one direction."""

    strongest_n: float  # size of the largest contact force; 0: nothing touches the body
    ahead_n: float  # sum of the contacts that push the body forward
    back_n: float  # sum of the contacts that push the body backward, as a positive number
    blocking_obstacle: str  # the obstacle with the largest backward force; "" without contacts
    touched: frozenset[str | None]  # names of the obstacles in contact; None: an obstacle without a name


class MeasuredContacts:
    """Averages the measured contact forces of the newest world models."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Sequence[WorldContact]]] = deque()  # sensor timestamp in ns, contacts

    def add_world(self, world: World) -> None:
        """Add the contacts of a world model; the same contacts may come again.

        Contacts that were estimated from joint torques show where the body touches, but not how hard, so they clear
        the average.
        """
        timestamp_ns = world.contacts_timestamp_ns
        if timestamp_ns is None or world.contacts_from == "joint_torques":
            self._samples.clear()
            return
        if self._samples and timestamp_ns == self._samples[-1][0]:
            return
        self._samples.append((timestamp_ns, world.contacts))
        while not 0 <= timestamp_ns - self._samples[0][0] < round(FORCE_WINDOW_S * 1e9):
            self._samples.popleft()

    def mean_sizes_n(self, obstacles: Sequence[str | None]) -> list[float | None]:
        """Return the size of each obstacle's mean force in N.

        Args:
            obstacles: names; None stands for a push-point without an obstacle, and gets None.

        Returns:
            One value for each obstacle, 0 without contact; an empty list if no sensor measures contact forces.
        """
        sizes: list[float | None] = []
        for name, force_w in zip(obstacles, self.mean_forces_w(obstacles), strict=False):
            if name is None:
                sizes.append(None)
            else:
                sizes.append(math.hypot(*force_w))
        return sizes

    def mean_forces_w(self, obstacles: Sequence[str | None]) -> list[tuple[float, float]]:
        """Return the mean horizontal force of each obstacle on the body, x and y in N.

        The list is empty if no sensor measures contact forces.
        """
        if not self._samples:
            return []
        sums: dict[str | None, tuple[float, float]] = {}
        for _, contacts in self._samples:
            for contact in contacts:
                x, y = sums.get(contact.obstacle, (0.0, 0.0))
                sums[contact.obstacle] = (x + contact.force_w[0], y + contact.force_w[1])
        count = len(self._samples)
        means: list[tuple[float, float]] = []
        for name in obstacles:
            x, y = sums.get(name, (0.0, 0.0))
            means.append((x / count, y / count))
        return means

    def resolve_along(self, direction_w: Sequence[float]) -> NetContactForce | None:
        """Resolve the mean contact forces along a direction.

        Args:
            direction_w: (2,) forward direction in the world, of any length above 0.

        Returns:
            The net force, or None if no sensor measures contact forces.
        """
        if not self._samples:
            return None
        sample_weight = 1.0 / len(self._samples)
        length = math.hypot(*direction_w)
        # A contact is identified by its link and obstacle.
        along_n: dict[tuple[int, str | None], float] = {}
        size_n: dict[tuple[int, str | None], float] = {}
        for _, contacts in self._samples:
            for contact in contacts:
                contact_id = (contact.link, contact.obstacle)
                force_w = contact.force_w
                forward_n = (force_w[0] * direction_w[0] + force_w[1] * direction_w[1]) / length
                along_n[contact_id] = along_n.get(contact_id, 0.0) + sample_weight * forward_n
                size_n[contact_id] = size_n.get(contact_id, 0.0) + sample_weight * math.hypot(*force_w)
        return NetContactForce(
            strongest_n=max(size_n.values(), default=0.0),
            ahead_n=math.fsum(force_n for force_n in along_n.values() if force_n > 0.0),
            back_n=-math.fsum(force_n for force_n in along_n.values() if force_n < 0.0),
            blocking_obstacle=_find_blocking_obstacle(along_n),
            touched=frozenset(obstacle for _, obstacle in along_n),
        )


def _find_blocking_obstacle(along_n: dict[tuple[int, str | None], float]) -> str:
    """Return the name of the obstacle with the smallest force along the body's way; "" without contacts."""
    if not along_n:
        return ""
    _, obstacle = min(along_n, key=lambda pair: along_n[pair])
    return obstacle or "an obstacle without a name"


def explain_standstill(
    force_n: float, net_force: NetContactForce | None, push_points: Sequence[str]
) -> tuple[bool, str]:
    """Explain why a body does not move, as far as its measured contacts show it.

    Args:
        force_n: commanded propulsion force.
        net_force: measured contact forces along the body; None without a sensor.
        push_points: names of the obstacles that should carry the propulsion force.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    pushing = f"standing still with {force_n:.1f} N of propulsion"
    if net_force is None:
        return False, f"{pushing}; what holds it is unknown without a sensor of contacts"
    if net_force.strongest_n == 0.0:
        return False, f"{pushing}, and no obstacle touches the body, so there is nothing to push off"
    if net_force.back_n > JAM_FORCE_RATIO * max(net_force.ahead_n, force_n):
        forces = f"push it on with {net_force.ahead_n:.0f} N and hold it back with {net_force.back_n:.0f} N"
        return True, f"jammed: {pushing}; obstacles {forces}, {net_force.blocking_obstacle} most"
    without_contact = [name for name in push_points if name not in net_force.touched]
    no_contact = ""
    if without_contact:
        no_contact = f" (no contact at {', '.join(without_contact)})"
    net_n = max(net_force.ahead_n - net_force.back_n, 0.0)
    return (
        False,
        f"{pushing}; contacts push it on with {net_n:.1f} N{no_contact}, too little against the friction of the ground",
    )

"""The net force of the measured contacts on a body, and why a body does not move.

All forces on a stationary body are in balance: the ground friction takes up the sum of the contact forces.
Forces are means over FORCE_WINDOW_S, because the force of one moment depends on how hard the surfaces are
(see `measured_force`).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.measured_force import FORCE_WINDOW_S
from snakesim_hal.wire.messages import WorldContact, WorldModel

# Contacts that push backward with more than this ratio of the forward push jam the body.
JAM_FORCE_RATIO = 0.5


@dataclass(frozen=True)
class NetContactForce:
    """Measured contact forces on the body, resolved along one direction."""

    max_contact_n: float  # magnitude of the largest contact force; 0 if nothing touches the body
    forward_n: float  # sum of the contacts that push the body forward
    backward_n: float  # sum of the contacts that push the body backward, as a positive number
    blocking_obstacle: str  # the obstacle with the largest backward force; "" without contacts
    # Names of the obstacles in contact; None stands for an obstacle without a name.
    touched_obstacles: frozenset[str | None]


class MeasuredContacts:
    """Averages the measured contact forces of the newest world models."""

    def __init__(self) -> None:
        # Sensor timestamp in ns, contacts.
        self._samples: deque[tuple[int, Sequence[WorldContact]]] = deque()

    def add_world(self, world: WorldModel) -> None:
        """Add the contacts of a world model to the average, unless they were added before.

        Contacts that were estimated from joint torques show where the body touches, but not how hard, so they clear
        the average. Samples that are older than FORCE_WINDOW_S are dropped.
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

    def compute_mean_magnitudes_n(self, obstacles: Sequence[str | None]) -> list[float | None]:
        """Compute the magnitude of the mean force of each obstacle on the body, in N.

        Args:
            obstacles: Names of obstacles; None stands for a push-point without an obstacle.

        Returns:
            One magnitude for each obstacle: 0 without contact, None for an obstacle of None. The list is empty if no
            sensor measures contact forces.
        """
        magnitudes_n: list[float | None] = []
        for name, force_w in zip(obstacles, self.compute_mean_forces_w(obstacles), strict=False):
            if name is None:
                magnitudes_n.append(None)
            else:
                magnitudes_n.append(math.hypot(*force_w))
        return magnitudes_n

    def compute_mean_forces_w(self, obstacles: Sequence[str | None]) -> list[tuple[float, float]]:
        """Compute the mean horizontal force of each obstacle on the body.

        Args:
            obstacles: Names of obstacles; None stands for obstacles without a name.

        Returns:
            x and y of the force in N for each obstacle, 0 without contact. The list is empty if no sensor measures
            contact forces.
        """
        if not self._samples:
            return []
        force_sums_w: dict[str | None, tuple[float, float]] = {}
        for _, contacts in self._samples:
            for contact in contacts:
                x, y = force_sums_w.get(contact.obstacle, (0.0, 0.0))
                force_sums_w[contact.obstacle] = (x + contact.force_w[0], y + contact.force_w[1])
        sample_count = len(self._samples)
        mean_forces_w: list[tuple[float, float]] = []
        for name in obstacles:
            x, y = force_sums_w.get(name, (0.0, 0.0))
            mean_forces_w.append((x / sample_count, y / sample_count))
        return mean_forces_w

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
        direction_length = math.hypot(*direction_w)
        # A contact is identified by its link and obstacle.
        forward_force_by_contact_n: dict[tuple[int, str | None], float] = {}
        magnitude_by_contact_n: dict[tuple[int, str | None], float] = {}
        for _, contacts in self._samples:
            for contact in contacts:
                contact_id = (contact.link, contact.obstacle)
                force_w = contact.force_w
                forward_n = (
                    force_w[0] * direction_w[0] + force_w[1] * direction_w[1]
                ) / direction_length
                forward_force_by_contact_n[contact_id] = (
                    forward_force_by_contact_n.get(contact_id, 0.0) + sample_weight * forward_n
                )
                magnitude_by_contact_n[contact_id] = magnitude_by_contact_n.get(
                    contact_id, 0.0
                ) + sample_weight * math.hypot(*force_w)
        return NetContactForce(
            max_contact_n=max(magnitude_by_contact_n.values(), default=0.0),
            forward_n=math.fsum(
                force_n for force_n in forward_force_by_contact_n.values() if force_n > 0.0
            ),
            backward_n=-math.fsum(
                force_n for force_n in forward_force_by_contact_n.values() if force_n < 0.0
            ),
            blocking_obstacle=_find_blocking_obstacle(forward_force_by_contact_n),
            touched_obstacles=frozenset(obstacle for _, obstacle in forward_force_by_contact_n),
        )


def _find_blocking_obstacle(forward_force_by_contact_n: dict[tuple[int, str | None], float]) -> str:
    """Return the name of the obstacle whose force is directed backward most; "" without contacts."""
    if not forward_force_by_contact_n:
        return ""
    _, obstacle = min(forward_force_by_contact_n, key=lambda pair: forward_force_by_contact_n[pair])
    return obstacle or "an obstacle without a name"


def explain_standstill(
    force_n: float, net_force: NetContactForce | None, push_points: Sequence[str]
) -> tuple[bool, str]:
    """Explain why a body does not move, as far as its measured contacts show it.

    Args:
        force_n: Commanded propulsion force.
        net_force: Measured contact forces along the body; None without a contact sensor.
        push_points: Names of the obstacles that should carry the propulsion force.

    Returns:
        Whether the body is jammed, and the reason as text.
    """
    push_description = f"standing still with {force_n:.1f} N of propulsion"
    if net_force is None:
        return False, f"{push_description}; what holds it is unknown without a sensor of contacts"
    if net_force.max_contact_n == 0.0:
        return (
            False,
            f"{push_description}, and no obstacle touches the body, so there is nothing to push off",
        )
    if net_force.backward_n > JAM_FORCE_RATIO * max(net_force.forward_n, force_n):
        forces = f"push it on with {net_force.forward_n:.0f} N and hold it back with {net_force.backward_n:.0f} N"
        return (
            True,
            f"jammed: {push_description}; obstacles {forces}, {net_force.blocking_obstacle} most",
        )
    obstacles_without_contact = [
        name for name in push_points if name not in net_force.touched_obstacles
    ]
    no_contact_note = ""
    if obstacles_without_contact:
        no_contact_note = f" (no contact at {', '.join(obstacles_without_contact)})"
    net_n = max(net_force.forward_n - net_force.backward_n, 0.0)
    return (
        False,
        f"{push_description}; contacts push it on with {net_n:.1f} N{no_contact_note}, "
        "too little against the friction of the ground",
    )

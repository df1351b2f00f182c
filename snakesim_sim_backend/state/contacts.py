"""Contacts of the snake with obstacles, read from MuJoCo's contacts.

Contacts with the ground, with steps and between the snake's own links are skipped by number before anything is
computed. Between two ticks the physics has flushed the processor's caches, and then a few plain floats cost less than a
chain of NumPy calls.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco

from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.laws.laws import StepContacts
from snakesim_sim_backend.model.build import SimModel

GeomPair = tuple[int, int]  # in MuJoCo's order
NO_FORCE = (0.0, 0.0, 0.0)


class ObstacleContact(NamedTuple):
    """One contact of a link with an obstacle over the last physics step; world frame."""

    link: int  # 0 at the tail
    obstacle: str
    position_w: Vector  # m
    normal_w: Vector  # from the obstacle into the body
    force_w: Vector  # N, on the body


class ObstacleContactReader:
    """Finds the contacts with obstacles in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, forces: StepContacts) -> None:
        self._contact = data.contact
        self._forces = forces
        self._obstacle_of_geom = sim.obstacle_of_geom
        self._obstacle_geoms = frozenset(
            i for i, name in enumerate(sim.obstacle_of_geom) if name is not None
        )
        self._link_of_geom: list[int] = (sim.model.geom_bodyid - sim.first_link_body).tolist()

    def read(self) -> Iterator[ObstacleContact]:
        """Yield all contacts of links with obstacles, in MuJoCo's order, with positions and forces in the world."""
        obstacle_geoms = self._obstacle_geoms
        pairs = self._forces.geom_pairs
        contact_indices = self._find_obstacle_contacts(pairs)
        if not contact_indices:
            return
        normal_force_n = self._forces.normal_force_n
        friction_force_w = self._forces.friction_force_w
        # Whole columns are converted at once: a view of each contact would cost more.
        frames = self._contact.frame.tolist()
        points_w = self._contact.pos.tolist()
        for i in contact_indices:
            first_geom, second_geom = pairs[i]
            # MuJoCo's normal points from the first geom to the second; here it points from the obstacle into the link.
            if first_geom in obstacle_geoms:
                obstacle_geom = first_geom
                link_geom = second_geom
                sign = 1.0
            else:
                obstacle_geom = second_geom
                link_geom = first_geom
                sign = -1.0
            x, y, z = (sign * component for component in frames[i][:3])
            normal_n = normal_force_n[i]
            fx, fy, fz = friction_force_w.get(i, NO_FORCE)
            yield ObstacleContact(
                link=self._link_of_geom[link_geom],
                obstacle=self._obstacle_of_geom[obstacle_geom] or "",
                position_w=tuple(points_w[i]),
                normal_w=(x, y, z),
                force_w=(fx + normal_n * x, fy + normal_n * y, fz + normal_n * z),
            )

    def sum_forces_n(self) -> dict[GeomPair, float]:
        """Return the sum of the contact forces between each link and each obstacle that it touches, in N.

        This runs in every physics step, so it computes the magnitude of each force from normal force and friction,
        which are at right angles, and adds the magnitudes instead of vectors.

        Returns:
            The sums by pairs of geoms, in MuJoCo's order. Contacts without a normal force are left out.
        """
        pairs = self._forces.geom_pairs
        contact_indices = self._find_obstacle_contacts(pairs)
        if not contact_indices:
            return {}
        normal_force_n = self._forces.normal_force_n
        friction_force_w = self._forces.friction_force_w
        sums_n: dict[GeomPair, float] = {}
        for i in contact_indices:
            normal_n = normal_force_n[i]
            if normal_n > 0.0:
                first_geom, second_geom = pairs[i]
                force_n = normal_n
                if i in friction_force_w:
                    fx, fy, fz = friction_force_w[i]
                    force_n = math.sqrt(normal_n * normal_n + fx * fx + fy * fy + fz * fz)
                sums_n[first_geom, second_geom] = (
                    sums_n.get((first_geom, second_geom), 0.0) + force_n
                )
        return sums_n

    def _find_obstacle_contacts(self, pairs: Sequence[Sequence[int]]) -> list[int]:
        """Return the indices of the contacts of which exactly one geom is an obstacle; the other one is a link."""
        obstacle_geoms = self._obstacle_geoms
        contact_indices: list[int] = []
        for i, (first_geom, second_geom) in enumerate(pairs):
            if (first_geom in obstacle_geoms) != (second_geom in obstacle_geoms):
                contact_indices.append(i)
        return contact_indices

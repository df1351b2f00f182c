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
from snakesim_sim_backend.laws.laws import ContactForces
from snakesim_sim_backend.model.build import SimModel

GeomPair = tuple[int, int]  # in MuJoCo's order
NO_FORCE = (0.0, 0.0, 0.0)


class Touch(NamedTuple):
    """One contact of a link with an obstacle over the last physics step; world frame."""

    link: int  # 0 at the tail
    obstacle: str
    position_w: Vector  # m
    normal_w: Vector  # from the obstacle into the body
    force_w: Vector  # N, on the body


class TouchReader:
    """Finds the contacts with obstacles in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, forces: ContactForces) -> None:
        self._contact = data.contact
        self._forces = forces
        self._obstacle_of_geom = sim.obstacle_of_geom
        self._obstacle_geoms = frozenset(i for i, name in enumerate(sim.obstacle_of_geom) if name is not None)
        self._link_of_geom: list[int] = (sim.model.geom_bodyid - sim.first_link_body).tolist()

    def read(self) -> Iterator[Touch]:
        """Yield all contacts of links with obstacles, in MuJoCo's order."""
        obstacle_geoms = self._obstacle_geoms
        pairs = self._forces.geom_pairs
        touching = self._find_touching(pairs)
        if not touching:
            return
        normal_force_n = self._forces.normal_force_n
        friction_force_w = self._forces.friction_force_w
        # Whole columns are converted at once: a view of each contact would cost more.
        frames = self._contact.frame.tolist()
        points_w = self._contact.pos.tolist()
        for i in touching:
            first, second = pairs[i]
            if first in obstacle_geoms:
                obstacle = first
                link = second
                sign = 1.0
            else:
                obstacle = second
                link = first
                sign = -1.0
            # MuJoCo's normal leads from the first geom to the second.
            x, y, z = (sign * component for component in frames[i][:3])
            normal_n = normal_force_n[i]
            fx, fy, fz = friction_force_w.get(i, NO_FORCE)
            yield Touch(
                link=self._link_of_geom[link],
                obstacle=self._obstacle_of_geom[obstacle] or "",
                position_w=tuple(points_w[i]),
                normal_w=(x, y, z),
                force_w=(fx + normal_n * x, fy + normal_n * y, fz + normal_n * z),
            )

    def sum_forces_n(self) -> dict[GeomPair, float]:
        """Return the summed force between each link and each obstacle that it touches, in N, by their geoms.

        It runs in every physics step, so it computes no vectors: friction is at right angles to the normal force.
        """
        pairs = self._forces.geom_pairs
        touching = self._find_touching(pairs)
        if not touching:
            return {}
        normal_force_n = self._forces.normal_force_n
        friction_force_w = self._forces.friction_force_w
        sums_n: dict[GeomPair, float] = {}
        for i in touching:
            normal_n = normal_force_n[i]
            if normal_n > 0.0:
                first, second = pairs[i]
                force_n = normal_n
                if i in friction_force_w:
                    fx, fy, fz = friction_force_w[i]
                    force_n = math.sqrt(normal_n * normal_n + fx * fx + fy * fy + fz * fz)
                sums_n[first, second] = sums_n.get((first, second), 0.0) + force_n
        return sums_n

    def _find_touching(self, pairs: Sequence[Sequence[int]]) -> list[int]:
        """Return the numbers of the contacts of one obstacle with something else, so with a link."""
        obstacle_geoms = self._obstacle_geoms
        touching: list[int] = []
        for i, (first, second) in enumerate(pairs):
            if (first in obstacle_geoms) != (second in obstacle_geoms):
                touching.append(i)
        return touching

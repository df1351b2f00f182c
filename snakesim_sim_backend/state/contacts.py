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
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.physics import Physics

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

    def __init__(self, sim: SimModel, data: mujoco.MjData, physics: Physics) -> None:
        self._contact = data.contact
        self._friction = physics.contacts
        self._obstacle_of_geom = sim.obstacle_of_geom
        self._obstacle_geoms = frozenset(i for i, name in enumerate(sim.obstacle_of_geom) if name is not None)
        self._link_of_geom: list[int] = (sim.model.geom_bodyid - sim.first_link_body).tolist()

    def read(self) -> Iterator[Touch]:
        """Yield all contacts of links with obstacles, in MuJoCo's order."""
        obstacle_geoms = self._obstacle_geoms
        pairs = self._friction.geom_pairs
        touching = self._find_touching(pairs)
        if not touching:
            return
        normal_force_n = self._friction.normal_force_n
        friction_force_w = self._friction.friction_force_w
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

    def sum_forces_n(self) -> dict[object, float]:
        """Return the summed force between each link and each obstacle that it touches, in N, by their geoms.

        It runs in every physics step, so it computes no vectors.
        """
        pairs = self._friction.geom_pairs
        touching = self._find_touching(pairs)
        if not touching:
            return {}
        normal_force_n = self._friction.normal_force_n
        friction_force_w = self._friction.friction_force_w
        sums_n: dict[object, float] = {}
        for i in touching:
            normal_n = normal_force_n[i]
            if normal_n > 0.0:
                first, second = pairs[i]
                force_n = normal_n
                if i in friction_force_w:
                    force_n = math.hypot(normal_n, *friction_force_w[i])
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

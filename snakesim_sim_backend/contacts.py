"""Contacts of the snake with obstacles, read from MuJoCo's contacts.

Ground, steps and the snake's own links are skipped by number before anything is computed. Between two ticks the
physics has flushed the processor's caches, and then a few plain floats cost less than a chain of numpy calls.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import mujoco

from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.physics import Physics

NO_FORCE = (0.0, 0.0, 0.0)


class Touch(NamedTuple):
    """One contact of a link with an obstacle over the last physics step; world frame."""

    link: int  # 0 at the tail
    obstacle: str
    position_w: Vector
    normal_w: Vector  # from the obstacle into the body
    force_w: Vector  # N, on the body


class TouchReader:
    """Finds the contacts in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, physics: Physics) -> None:
        self._contact, self._made = data.contact, physics.contacts
        self._obstacles = sim.obstacle_of_geom
        self._struck = frozenset(i for i, name in enumerate(sim.obstacle_of_geom) if name is not None)
        self._links: list[int] = (sim.model.geom_bodyid - sim.first_link_body).tolist()

    def read(self) -> Iterator[Touch]:
        """All contacts, in MuJoCo's order."""
        struck, made = self._struck, self._made
        found = [i for i, (first, second) in enumerate(made.pairs) if (first in struck) != (second in struck)]
        if not found:
            return
        # Whole columns at once: a view of each contact would cost more.
        frames, places = self._contact.frame.tolist(), self._contact.pos.tolist()
        for i in found:
            first, second = made.pairs[i]
            link, obstacle, sign = (second, first, 1.0) if first in struck else (first, second, -1.0)
            x, y, z = (sign * along for along in frames[i][:3])  # MuJoCo's is from the first geom to the second
            push_n, (fx, fy, fz) = made.push_n[i], made.rub_w.get(i, NO_FORCE)
            force_w = (fx + push_n * x, fy + push_n * y, fz + push_n * z)
            yield Touch(self._links[link], self._obstacles[obstacle] or "", tuple(places[i]), (x, y, z), force_w)

    def sizes_n(self) -> dict[object, float]:
        """Size of the force between each link and each obstacle that it touches; for every physics step, so quick."""
        found: dict[object, float] = {}
        rub_w, struck = self._made.rub_w, self._struck
        for i, ((first, second), push_n) in enumerate(zip(self._made.pairs, self._made.push_n, strict=True)):
            if push_n > 0.0 and (first in struck) != (second in struck):
                size_n = math.hypot(push_n, *rub_w[i]) if i in rub_w else push_n
                found[first, second] = found.get((first, second), 0.0) + size_n
        return found

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


class Touch(NamedTuple):
    """One contact of a link with an obstacle over the last physics step; world frame."""

    body: int  # MuJoCo's number
    obstacle: str
    position_w: Vector
    normal_w: Vector  # from the obstacle into the body
    force_w: Vector  # N, on the body


class TouchReader:
    """Finds the contacts in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData) -> None:
        self._data, self._contact = data, data.contact
        self._obstacles = sim.obstacle_of_geom
        self._struck = frozenset(i for i, name in enumerate(sim.obstacle_of_geom) if name is not None)
        self._bodies: list[int] = sim.model.geom_bodyid.tolist()

    def read(self) -> Iterator[Touch]:
        """All contacts, in MuJoCo's order."""
        struck, contact = self._struck, self._contact
        pairs = contact.geom.tolist()
        found = [i for i, (first, second) in enumerate(pairs) if (first in struck) != (second in struck)]
        if not found:
            return
        # Whole columns at once: a view of each contact would cost more.
        frames, places = contact.frame.tolist(), contact.pos.tolist()
        starts, sizes = contact.efc_address.tolist(), contact.dim.tolist()
        for i in found:
            first, second = pairs[i]
            forces = self._data.efc_force[starts[i] : starts[i] + sizes[i]].tolist()
            link, obstacle, sign = (second, first, 1.0) if first in struck else (first, second, -1.0)
            yield self._touch(frames[i], places[i], forces, link, self._obstacles[obstacle], sign)

    def sizes_n(self) -> dict[object, float]:
        """Size of the force between each link and each obstacle that it touches; for every physics step, so quick."""
        contact = self._contact
        if not len(contact):
            return {}
        found: dict[object, float] = {}
        forces = self._data.efc_force
        rows = zip(contact.geom.tolist(), contact.efc_address.tolist(), contact.dim.tolist(), strict=True)
        for (first, second), start, size in rows:
            if start >= 0 and (first in self._struck) != (second in self._struck):
                push_n = float(forces[start])
                if size > 1:
                    push_n = math.hypot(push_n, forces[start + 1], forces[start + 2])
                found[first, second] = found.get((first, second), 0.0) + push_n
        return found

    def _touch(
        self, frame: list[float], place: list[float], forces: list[float], link: int, obstacle: str | None, sign: float
    ) -> Touch:
        """MuJoCo's frame has the normal from the first geom to the second, then two tangents, as rows.

        sign: 1 if that is from the obstacle into the body, -1 if the other way round.
        """
        nx, ny, nz, ax, ay, az, bx, by, bz = frame
        x, y, z = place
        push, *rub = forces
        push *= sign
        fx, fy, fz = push * nx, push * ny, push * nz
        if rub:
            a, b = sign * rub[0], sign * rub[1]
            fx, fy, fz = fx + a * ax + b * bx, fy + a * ay + b * by, fz + a * az + b * bz
        return Touch(self._bodies[link], obstacle or "", (x, y, z), (sign * nx, sign * ny, sign * nz), (fx, fy, fz))

"""Readings of the force sensors: per link, the resultant of all contacts with obstacles."""

import math

import mujoco

from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_sim_backend.contacts import TouchReader
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.sensors.frames import into

Sums = tuple[float, float, float, float, float, float, float]


class LoadReader:
    """Adds up the contacts in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, physics: Physics) -> None:
        self._touches = TouchReader(sim, data, physics)
        first = sim.first_link_body
        self._origins, self._rotations = data.xpos[first:], data.xmat[first:]  # of links and what follows

    def read(self) -> list[LinkLoad]:
        """Loads of the links in contact, tail to head; a contact without force is ignored."""
        sums: dict[int, Sums] = {}
        for touch in self._touches.read():
            (fx, fy, fz), (x, y, z) = touch.force_w, touch.position_w
            weight = math.sqrt(fx * fx + fy * fy + fz * fz)
            if weight > 0.0:
                w, wx, wy, wz, sx, sy, sz = sums.get(touch.link, (0.0,) * 7)
                sums[touch.link] = (
                    *(w + weight, wx + weight * x, wy + weight * y, wz + weight * z),
                    *(sx + fx, sy + fy, sz + fz),
                )
        return [self._load(link, sums[link]) for link in sorted(sums)]

    def _load(self, link: int, sums: Sums) -> LinkLoad:
        weight, x, y, z, *force_w = sums
        rotation = self._rotations[link].tolist()  # world_from_link, row by row
        ox, oy, oz = self._origins[link].tolist()
        fx, fy, fz = force_w
        return LinkLoad(
            link=link,
            position_l=into(rotation, (x / weight - ox, y / weight - oy, z / weight - oz)),
            force_l=into(rotation, (fx, fy, fz)),
        )

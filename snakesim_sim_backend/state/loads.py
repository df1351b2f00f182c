"""Readings of the force sensors: per link, the resultant of all contacts with obstacles."""

import math
from dataclasses import dataclass

import mujoco

from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.sensors.frames import rotate_into_frame
from snakesim_sim_backend.state.contacts import ObstacleContact, ObstacleContactReader


@dataclass
class _WeightedSum:
    """Contacts of one link, added up in the world frame."""

    weight_n: float = 0.0  # sum of the magnitudes of the forces
    x: float = 0.0  # sum of the positions, each times the magnitude of its force, N·m
    y: float = 0.0
    z: float = 0.0
    fx: float = 0.0  # sum of the forces, N
    fy: float = 0.0
    fz: float = 0.0

    def add(self, touch: ObstacleContact, force_n: float) -> None:
        """Add a contact. force_n: size of its force."""
        x, y, z = touch.position_w
        fx, fy, fz = touch.force_w
        self.weight_n += force_n
        self.x += force_n * x
        self.y += force_n * y
        self.z += force_n * z
        self.fx += fx
        self.fy += fy
        self.fz += fz


class LinkLoadReader:
    """Adds up the contacts in a simulation's data."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, physics: PhysicsStepper) -> None:
        first = sim.first_link_body
        self._contact_reader = ObstacleContactReader(sim, data, physics.contacts)
        self._origins = data.xpos[first:]  # of links, and of the bodies behind them
        self._rotations = data.xmat[first:]

    def read(self) -> list[LinkLoad]:
        """Return the loads of the links in contact, tail to head; a contact without force is ignored."""
        sums: dict[int, _WeightedSum] = {}
        for touch in self._contact_reader.read():
            fx, fy, fz = touch.force_w
            force_n = math.sqrt(fx * fx + fy * fy + fz * fz)
            if force_n > 0.0:
                if touch.link not in sums:
                    sums[touch.link] = _WeightedSum()
                sums[touch.link].add(touch, force_n)
        return [self._make_load(link, sums[link]) for link in sorted(sums)]

    def _make_load(self, link_index: int, total: _WeightedSum) -> LinkLoad:
        """Return a link's load: the sum of the forces, at the mean position weighted by their sizes."""
        rotation = self._rotations[link_index].tolist()  # world_from_link, row by row
        ox, oy, oz = self._origins[link_index].tolist()
        weight_n = total.weight_n
        offset_w = (total.x / weight_n - ox, total.y / weight_n - oy, total.z / weight_n - oz)
        return LinkLoad(
            link=link_index,
            position_l=rotate_into_frame(rotation, offset_w),
            force_l=rotate_into_frame(rotation, (total.fx, total.fy, total.fz)),
        )

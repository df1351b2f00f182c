"""Contacts of the links with obstacles."""

import math

import mujoco

from snakesim_hal.model.kinematics import tangents
from snakesim_hal.model.measured_force import FeltForce
from snakesim_hal.model.sensors import ContactSensor
from snakesim_hal.wire.messages import Contact, Contacts
from snakesim_hal.wire.quantities import MAX_CONTACTS
from snakesim_sim_backend.contacts import Touch, TouchReader
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.sensors.frames import into
from snakesim_sim_backend.sensors.scope import Normal

LARGEST_N = 1e7  # as a message may carry
NO_TORQUE = (0.0, 0.0, 0.0)  # a point contact carries no moment about its own point


class ContactReader:
    """Contacts with obstacles, in the frames of the links."""

    def __init__(
        self, sim: SimModel, data: mujoco.MjData, sensor: ContactSensor, noise: Normal, physics: Physics
    ) -> None:
        self._touches = TouchReader(sim, data, physics)
        first = sim.first_link_body
        self._origins, self._rotations = data.xpos[first:], data.xmat[first:]  # of links and what follows
        self._threshold_n = sensor.threshold_n
        self._sigma_m, self._sigma_n = sensor.position_noise_m, sensor.force_noise_n
        self._noise = noise if self._sigma_m or self._sigma_n else None
        self._felt = FeltForce(sim.model.opt.timestep)
        physics.after_step = self._feel

    def read(self, tick: int, timestamp_ns: int) -> Contacts:
        """All contacts above the threshold."""
        found = [
            self._in_link(touch) for touch in self._touches.read() if math.hypot(*touch.force_w) >= self._threshold_n
        ]
        measured_force_n = self._felt.max_n
        if not measured_force_n < LARGEST_N:  # also what is no number: of the steps in which a simulation diverged
            measured_force_n = None
        return Contacts(
            tick=tick, timestamp_ns=timestamp_ns, contacts=found[:MAX_CONTACTS], measured_force_n=measured_force_n
        )

    def _feel(self) -> None:
        self._felt.add(self._touches.sum_forces_n())

    def _in_link(self, touch: Touch) -> Contact:
        rotation = self._rotations[touch.link].tolist()  # world_from_link, row by row
        ox, oy, oz = self._origins[touch.link].tolist()
        x, y, z = touch.position_w
        px, py, pz = into(rotation, (x - ox, y - oy, z - oz))
        fx, fy, fz = into(rotation, touch.force_w)
        normal = into(rotation, touch.normal_w)
        if self._noise is not None:
            a, b, c, d, e, f = self._noise(6).tolist()
            m, n = self._sigma_m, self._sigma_n
            px, py, pz, fx, fy, fz = px + m * a, py + m * b, pz + m * c, fx + n * d, fy + n * e, fz + n * f
        tangent_1, tangent_2 = tangents(normal)
        return Contact(
            link=touch.link,
            obstacle=touch.obstacle,
            position_l=(px, py, pz),
            normal_l=normal,
            tangent_1_l=tangent_1,
            tangent_2_l=tangent_2,
            force_l=(fx, fy, fz),
            torque_l=NO_TORQUE,
        )

"""Measures the contacts of the links with obstacles, as a contact sensor with noise does."""

import math

import mujoco

from snakesim_hal.model.geometry.kinematics import compute_contact_tangents
from snakesim_hal.model.robot_file.sensors import ContactSensor
from snakesim_hal.wire.messages import Contact, Contacts
from snakesim_hal.wire.quantities import MAX_CONTACTS
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.sensors.frames import rotate_into_frame
from snakesim_sim_backend.sensors.scope import Normal
from snakesim_sim_backend.state.contacts import ObstacleContact, ObstacleContactReader

MAX_FORCE_N = 1e7  # that a message may carry
NO_TORQUE = (0.0, 0.0, 0.0)  # a point contact carries no moment about its own point


class ContactReader:
    """Measures the contacts with obstacles, in the frames of the links."""

    def __init__(
        self,
        sim: SimModel,
        data: mujoco.MjData,
        sensor: ContactSensor,
        noise: Normal,
        physics: PhysicsStepper,
    ) -> None:
        first = sim.first_link_body
        self._contact_reader = ObstacleContactReader(sim, data, physics.contacts)
        self._origins = data.xpos[first:]  # of links, and of the bodies behind them
        self._rotations = data.xmat[first:]
        self._threshold_n = sensor.threshold_n
        self._sigma_m = sensor.position_noise_m
        self._sigma_n = sensor.force_noise_n
        self._noise: Normal | None = None
        if self._sigma_m or self._sigma_n:
            self._noise = noise
        self._measured_force = physics.start_force_measurement()

    def read(self, tick: int, timestamp_ns: int) -> Contacts:
        """Return all contacts above the threshold, and the largest force since the last reading."""
        contacts = [
            self._measure_contact(touch)
            for touch in self._contact_reader.read()
            if math.hypot(*touch.force_w) >= self._threshold_n
        ]
        max_force_n = self._measured_force.max_n
        if not max_force_n < MAX_FORCE_N:  # also NaN, of the steps in which a simulation diverged
            max_force_n = None
        return Contacts(
            tick=tick,
            timestamp_ns=timestamp_ns,
            contacts=contacts[:MAX_CONTACTS],
            measured_force_n=max_force_n,
        )

    def _measure_contact(self, touch: ObstacleContact) -> Contact:
        """Return a contact in the frame of its link, with noise on its position and its force.

        Args:
            touch: Contact in the world frame, without noise.
        """
        rotation = self._rotations[touch.link].tolist()  # world_from_link, row by row
        ox, oy, oz = self._origins[touch.link].tolist()
        x, y, z = touch.position_w
        px, py, pz = rotate_into_frame(rotation, (x - ox, y - oy, z - oz))
        fx, fy, fz = rotate_into_frame(rotation, touch.force_w)
        normal = rotate_into_frame(rotation, touch.normal_w)
        if self._noise is not None:
            noise_px, noise_py, noise_pz, noise_fx, noise_fy, noise_fz = self._noise(6).tolist()
            px = px + self._sigma_m * noise_px
            py = py + self._sigma_m * noise_py
            pz = pz + self._sigma_m * noise_pz
            fx = fx + self._sigma_n * noise_fx
            fy = fy + self._sigma_n * noise_fy
            fz = fz + self._sigma_n * noise_fz
        tangent_1, tangent_2 = compute_contact_tangents(normal)
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

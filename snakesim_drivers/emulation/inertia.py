"""A physics model without a world: every joint turns an inertia of its own. For tests of the bus without physics.

It does *not* simulate gravity, ground, obstacles, or coupling between joints.
"""

from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import RunConfig, find_start_pose
from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_hal.wire.quantities import from_zero

MIN_INERTIA_KG_M2 = 1e-6


class InertiaSettings(FileStruct, frozen=True, kw_only=True):
    """Time step, and friction of gears and ground."""

    timestep_s: Annotated[float, Meta(ge=1e-5, le=0.01, extra_json_schema={"unit": "s"})] = 0.001
    # Dry friction of every joint, in addition to the robot file's: without it a released joint would turn for ever.
    drag_nm: Annotated[float, from_zero(100, "N·m")] = 0.1


class InertiaModel:
    """A `PhysicsModel`: rotor and one link, turned about the link's middle, with friction and end stops."""

    Settings = InertiaSettings

    def __init__(self, config: RunConfig, settings: InertiaSettings) -> None:
        """At the run's start pose, at rest. The step is shortened so that a control period is a multiple of it."""
        robot, joints = config.robot, config.robot.joint_table
        period_s = config.period_ns * 1e-9
        self.step_s = period_s / max(int(np.ceil(period_s / settings.timestep_s - 1e-9)), 1)
        links = [mass * length**2 / 12 for mass, length in zip(robot.link_masses_kg, robot.link_lengths_m, strict=True)]
        inertia = np.maximum(
            np.array([joint.motor.armature_kg_m2 for joint in joints]) + np.array(links[1:]), MIN_INERTIA_KG_M2
        )
        self._speed_per_nm = self.step_s / inertia
        viscous = np.array([joint.motor.viscous_nm_s_per_rad for joint in joints])
        self._keep = 1.0 / (1.0 + self._speed_per_nm * viscous)  # implicit: stable at any friction
        dry_nm = np.array([joint.motor.friction_nm for joint in joints]) + settings.drag_nm
        self._rubbed_off = self._speed_per_nm * dry_nm
        self._least = np.array([joint.limits.lower_rad for joint in joints])
        self._most = np.array([joint.limits.upper_rad for joint in joints])
        self._angle: Floats = np.array(find_start_pose(config).angles_rad, dtype=np.float64)
        self._velocity = np.zeros(len(self._angle))
        self._torque = np.zeros(len(self._angle))
        self._change = np.zeros(len(self._angle))

    def advance(self, torque_nm: Floats) -> None:
        """One step, semi-implicit; dry friction never reverses a joint, and end stops absorb all its motion."""
        angle, velocity, change = self._angle, self._velocity, self._change
        self._torque[:] = torque_nm
        np.multiply(torque_nm, self._speed_per_nm, out=change)
        velocity += change
        velocity *= self._keep
        np.clip(velocity, -self._rubbed_off, self._rubbed_off, out=change)
        velocity -= change
        np.multiply(velocity, self.step_s, out=change)
        angle += change
        np.clip(angle, self._least, self._most, out=change)
        change -= angle
        if change.any():  # also for NaN
            self._stop(change)

    @property
    def angle_rad(self) -> Floats:
        """Joint angles now, (n_joints,); a view."""
        return self._angle

    @property
    def velocity_rad_s(self) -> Floats:
        """Joint velocities now, (n_joints,); a view."""
        return self._velocity

    def shaft_torque_nm(self) -> Floats:
        """The motors' torques of the last step, as for rotors without inertia, (n_joints,)."""
        return self._torque

    def loads(self) -> list[LinkLoad]:
        """No world, no contacts."""
        return []

    def imu(self) -> Imu | None:
        """No world, no IMU."""
        return None

    def pose(self) -> Pose | None:
        """No world, no pose."""
        return None

    def _stop(self, back_rad: Floats) -> None:
        if not np.isfinite(self._angle).all():
            raise BackendError(
                "inertia physics model: a joint angle is NaN or infinite, because a torque was",
                code="simulator/diverged",
            )
        self._velocity[self._velocity * back_rad < 0] = 0.0
        np.clip(self._angle, self._least, self._most, out=self._angle)

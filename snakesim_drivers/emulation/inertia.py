"""A physics model without a world: every joint rotates an inertia of its own. For tests of the bus without physics.

In each step of length h, with torque τ, inertia J, viscous friction b, dry friction d and velocity v:

    v <- (v + h/J · τ) / (1 + h/J · b)             implicit, so that it is stable at any friction
    v <- v - clip(v, -h/J · d, +h/J · d)           dry friction slows a joint, and never reverses it
    q <- q + h · v                                 semi-implicit Euler

End stops absorb all motion. The model does *not* simulate gravity, ground, obstacles, or coupling between joints.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_drivers.emulation.bending_hand import BendingHand
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import RunConfig, compute_start_pose
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.wire.quantities import from_zero

MIN_INERTIA_KG_M2 = 1e-6  # of a joint, so that the equations have a solution for any robot file
# Steps per period; a quotient of floats may exceed its whole number by less.
STEP_COUNT_TOLERANCE = 1e-9


class InertiaSettings(FileStruct, frozen=True, kw_only=True):
    """Time step, and friction of gears and ground."""

    timestep_s: Annotated[float, Meta(ge=1e-5, le=0.01, extra_json_schema={"unit": "s"})] = 0.001
    """Longest time step. It is shortened so that a control period is a multiple of it."""

    drag_nm: Annotated[float, from_zero(100, "N·m")] = 0.1
    """Dry friction of every joint, in addition to the robot file's, so that a released joint comes to rest."""

    hand_file: str = ""
    """File with the angle of every joint in rad, tail to head, separated by spaces. When it changes, a hand bends the
    joints whose motors are off to these angles. Empty: there is no hand.
    """


class InertiaModel(PhysicsModel):
    """Rotor and one link for each joint, rotating about the link's middle, with friction and end stops."""

    Settings = InertiaSettings

    def __init__(self, config: RunConfig, settings: InertiaSettings) -> None:
        """Create the model at the run's start pose, at rest.

        Each joint moves the inertia of its rotor and of the link ahead of it. The time step is shortened so that a
        control period is a multiple of it.

        Args:
            config: Configuration of the run, with robot and start pose.
            settings: Maximum time step, and dry friction in addition to that of the robot file.
        """
        robot = config.robot
        joints = robot.joint_table
        count = len(joints)
        period_s = config.period_ns * 1e-9
        steps_per_period = max(
            int(np.ceil(period_s / settings.timestep_s - STEP_COUNT_TOLERANCE)), 1
        )
        self.step_s = period_s / steps_per_period

        # Inertia and friction of every joint.
        link_inertias_kg_m2 = [
            mass_kg * length_m**2 / 12
            for mass_kg, length_m in zip(robot.link_masses_kg, robot.link_lengths_m, strict=True)
        ]
        rotor_inertias_kg_m2 = np.array([joint.motor.armature_kg_m2 for joint in joints])
        inertias_kg_m2 = np.maximum(
            rotor_inertias_kg_m2 + np.array(link_inertias_kg_m2[1:]), MIN_INERTIA_KG_M2
        )
        viscous_friction_nm_s_per_rad = np.array(
            [joint.motor.viscous_nm_s_per_rad for joint in joints]
        )
        dry_friction_nm = np.array([joint.motor.friction_nm for joint in joints]) + settings.drag_nm
        # Rad/s that 1 N·m adds in one step.
        self._velocity_step_per_nm = self.step_s / inertias_kg_m2
        self._viscous_damping_factor = 1.0 / (
            1.0 + self._velocity_step_per_nm * viscous_friction_nm_s_per_rad
        )
        # Velocity that dry friction removes in one step.
        self._dry_friction_step_rad_s = self._velocity_step_per_nm * dry_friction_nm
        self._lower_rad = np.array([joint.limits.lower_rad for joint in joints])
        self._upper_rad = np.array([joint.limits.upper_rad for joint in joints])

        # State.
        self._angle_rad: Floats = np.array(compute_start_pose(config).angles_rad, dtype=np.float64)
        self._velocity_rad_s = np.zeros(count)
        self._torque_nm = np.zeros(count)
        # Intermediate results of a step, so that it allocates no memory.
        self._velocity_change_rad_s = np.zeros(count)
        self._friction_change_rad_s = np.zeros(count)
        self._angle_change_rad = np.zeros(count)
        self._correction_rad = np.zeros(count)
        # The hand of a person who bends joints whose motors are off; None if there is none.
        self._hand: BendingHand | None = None
        if settings.hand_file:
            self._hand = BendingHand(Path(settings.hand_file), count)

    def advance(self, torque_nm: Floats) -> None:
        """Advance by one step of semi-implicit Euler integration, without allocating memory.

        Viscous friction is implicit, so that any coefficient is stable. Dry friction takes a fixed part of the
        velocity, but never reverses a motion.

        Args:
            torque_nm: (n_joints,) torques of the motors during the step.

        Raises:
            BackendError: An angle is not finite, or the file of the bending hand is invalid.
        """
        angle_rad = self._angle_rad
        velocity_rad_s = self._velocity_rad_s
        self._torque_nm[:] = torque_nm

        # The motors' torques accelerate the joints.
        velocity_change_rad_s = self._velocity_change_rad_s
        np.multiply(torque_nm, self._velocity_step_per_nm, out=velocity_change_rad_s)
        velocity_rad_s += velocity_change_rad_s

        # Viscous friction slows them in proportion to their velocity.
        velocity_rad_s *= self._viscous_damping_factor

        # Dry friction removes a fixed part of each velocity, or all of it if that is less.
        friction_change_rad_s = self._friction_change_rad_s
        max_change_rad_s = self._dry_friction_step_rad_s
        np.clip(velocity_rad_s, -max_change_rad_s, max_change_rad_s, out=friction_change_rad_s)
        velocity_rad_s -= friction_change_rad_s

        # A hand replaces the velocities of joints whose motors are off.
        if self._hand is not None:
            self._hand.bend_passive_joints(angle_rad, velocity_rad_s, torque_nm, self.step_s)

        # The joints rotate at their new velocities.
        angle_change_rad = self._angle_change_rad
        np.multiply(velocity_rad_s, self.step_s, out=angle_change_rad)
        angle_rad += angle_change_rad

        # The angle from each joint back to the nearest end stop; 0 within its travel.
        correction_rad = self._correction_rad
        np.clip(angle_rad, self._lower_rad, self._upper_rad, out=correction_rad)
        correction_rad -= angle_rad
        if correction_rad.any():  # a joint is beyond an end stop, or its angle is NaN
            self._stop_at_limits(correction_rad)

    @property
    def angle_rad(self) -> Floats:
        return self._angle_rad

    @property
    def velocity_rad_s(self) -> Floats:
        return self._velocity_rad_s

    def shaft_torque_nm(self) -> Floats:
        """Return the motors' torques of the last step, as for rotors without inertia, (n_joints,)."""
        return self._torque_nm

    def _stop_at_limits(self, correction_rad: Floats) -> None:
        """Stop the joints beyond their end stops.

        Args:
            correction_rad: Angle back to the end stop for each joint, (n_joints,); 0 for joints within their travel.

        Raises:
            BackendError: An angle is not finite.
        """
        if not np.isfinite(self._angle_rad).all():
            raise BackendError(
                "inertia physics model: a joint angle is NaN or infinite, because a torque was",
                code="simulator/diverged",
            )
        moves_outwards = self._velocity_rad_s * correction_rad < 0
        self._velocity_rad_s[moves_outwards] = 0.0
        np.clip(self._angle_rad, self._lower_rad, self._upper_rad, out=self._angle_rad)

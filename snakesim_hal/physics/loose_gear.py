"""A physics model whose drives reach some of its links through loose gears: with backlash, or a coupling that slips.

An encoder on the motor's side of backlash rotates through it at each reversal, while the link stays where it is. Behind
a coupling that slips, the link stops at the torque at which the coupling slips, while the encoder rotates on. The rotor
of such a joint therefore has an angle of its own:

    rotor_inertia * rotor_acceleration = motor torque - rotor friction - tooth torque

The tooth torque acts on the link. It is 0 while the teeth are apart, and that of a stiff, damped spring otherwise. It
never exceeds the torque at which the coupling slips.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint, JointExceptions
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.physics.wrapped_model import WrappedModel

# Softer than most gears; an explicit step of 1 ms integrates it on a light link.
TOOTH_STIFFNESS_NM_PER_RAD = 300.0
TOOTH_DAMPING_NM_S_PER_RAD = 0.3  # teeth hardly rebound
LINK_SIDE_INERTIA_RATIO = 0.1  # of the rotor's inertia: the gear's output stage stays on the link
MIN_ROTOR_INERTIA_KG_M2 = 1e-4  # a rotor without inertia could not be integrated


@dataclass(frozen=True, kw_only=True)
class Looseness:
    """How loose the gear of a joint is."""

    backlash_rad: float = 0.0  # total, peak to peak
    slip_torque_nm: float = np.inf  # at which the coupling slips; infinite: it does not slip


def move_rotor_inertia_to_motor_side(
    config: RunConfig, joints: Sequence[Joint], loose_joint_names: Collection[str]
) -> RunConfig:
    """Return a configuration in which joints with loose gears have no friction and only a part of their rotor inertia.

    The physics model of the links is made from it. `LooseGearModel` simulates the rotors of these joints itself.

    Args:
        config: Configuration of the run.
        joints: Every joint with its true (not nominal) parameters, tail to head.
        loose_joint_names: Names of the joints with loose gears.
    """
    exceptions = dict(config.robot.joints)
    for joint in joints:
        if joint.name not in loose_joint_names:
            continue
        exceptions[joint.name] = msgspec.structs.replace(
            exceptions.get(joint.name, JointExceptions()),
            armature_kg_m2=LINK_SIDE_INERTIA_RATIO * joint.motor.armature_kg_m2,
            friction_nm=0.0,
            viscous_nm_s_per_rad=0.0,
        )
    return msgspec.structs.replace(
        config, robot=msgspec.structs.replace(config.robot, joints=exceptions)
    )


class LooseGearModel(WrappedModel):
    """Wraps another physics model. Its joint angles are those that encoders on the rotors measure."""

    def __init__(
        self,
        physics_model: PhysicsModel,
        joints: Sequence[Joint],
        looseness: Mapping[str, Looseness],
        seed: int,
    ) -> None:
        """Place every rotor at a random angle within its backlash, at rest.

        Args:
            physics_model: Model of the links. It is made from the configuration that `move_rotor_inertia_to_motor_side`
                of this module returns, so that the inertia and the friction of these rotors are not simulated twice.
            joints: Every joint with its true (not nominal) parameters, tail to head.
            looseness: How loose a gear is, by joint name. The gears of joints that are missing are not loose.
            seed: Seed of the random start angles of the rotors.
        """
        super().__init__(physics_model)

        # Indices and rotor parameters of the joints with loose gears. Every array has one entry for each of them.
        loose_joints = [i for i, joint in enumerate(joints) if joint.name in looseness]
        motors = [joints[i].motor for i in loose_joints]
        self._loose_joints = np.array(loose_joints, dtype=np.intp)
        self._half_backlash_rad: Floats = np.array(
            [looseness[joints[i].name].backlash_rad / 2 for i in loose_joints]
        )
        self._slip_torque_nm: Floats = np.array(
            [looseness[joints[i].name].slip_torque_nm for i in loose_joints]
        )
        # MuJoCo calls the reflected rotor inertia "armature".
        self._rotor_inertia_kg_m2: Floats = np.array(
            [max(motor.armature_kg_m2, MIN_ROTOR_INERTIA_KG_M2) for motor in motors]
        )
        self._friction_nm: Floats = np.array([motor.friction_nm for motor in motors])
        self._viscous_damping_nm_s_per_rad: Floats = np.array(
            [motor.viscous_nm_s_per_rad for motor in motors]
        )

        # State of the rotors, in units of the joint: behind the gear reduction.
        rng = np.random.default_rng(seed)
        offset_rad = rng.uniform(-1.0, 1.0, len(loose_joints)) * self._half_backlash_rad
        self._rotor_angle_rad: Floats = physics_model.angle_rad[self._loose_joints] + offset_rad
        self._rotor_velocity_rad_s: Floats = np.zeros(len(loose_joints))
        self._tooth_torque_nm: Floats = np.zeros(len(loose_joints))
        self._slipped_rad: Floats = np.zeros(len(loose_joints))  # by couplings, since the start

    def advance(self, torque_nm: Floats) -> None:
        """Advance rotors and links by `step_s` under these motor torques."""
        self._advance_rotors(torque_nm[self._loose_joints])
        link_torque_nm = torque_nm.copy()
        link_torque_nm[self._loose_joints] = self._tooth_torque_nm
        self._physics_model.advance(link_torque_nm)

    def _advance_rotors(self, motor_torque_nm: Floats) -> None:
        """Advance angles, velocities and tooth torques of the rotors by a step, while the links keep their velocity.

        The step is implicit in the spring and the damper of the teeth, and in the viscous friction. Coulomb friction
        is applied afterwards, and at most stops the rotor.

        Args:
            motor_torque_nm: Motor torques of the joints with loose gears.
        """
        step_s = self.step_s
        link_angle_rad = self._physics_model.angle_rad[self._loose_joints]
        link_velocity_rad_s = self._physics_model.velocity_rad_s[self._loose_joints]

        # The teeth touch where the angle between rotor and link is larger than half of the backlash.
        relative_angle_rad = self._rotor_angle_rad - link_angle_rad - self._slipped_rad
        penetration_rad = relative_angle_rad - np.clip(
            relative_angle_rad, -self._half_backlash_rad, self._half_backlash_rad
        )
        is_touching = penetration_rad != 0.0
        stiffness = np.where(is_touching, TOOTH_STIFFNESS_NM_PER_RAD, 0.0)
        damping = np.where(is_touching, TOOTH_DAMPING_NM_S_PER_RAD, 0.0)
        relative_velocity_rad_s = self._rotor_velocity_rad_s - link_velocity_rad_s
        explicit_tooth_torque_nm = (
            stiffness * (penetration_rad + step_s * relative_velocity_rad_s)
            + damping * relative_velocity_rad_s
        )
        rotor_velocity_rad_s = self._compute_rotor_velocities(
            motor_torque_nm - explicit_tooth_torque_nm, step_s * damping + step_s**2 * stiffness
        )

        # Torque on the links at the end of the step.
        relative_velocity_rad_s = rotor_velocity_rad_s - link_velocity_rad_s
        tooth_torque_nm = stiffness * (penetration_rad + step_s * relative_velocity_rad_s)
        tooth_torque_nm = tooth_torque_nm + damping * relative_velocity_rad_s
        is_pushing = tooth_torque_nm * penetration_rad > 0.0  # teeth do not pull
        tooth_torque_nm = np.where(is_pushing, tooth_torque_nm, 0.0)
        is_slipping = np.abs(tooth_torque_nm) > self._slip_torque_nm
        if is_slipping.any():
            tooth_torque_nm = np.clip(tooth_torque_nm, -self._slip_torque_nm, self._slip_torque_nm)
            # A slipping coupling is no spring: it brakes the rotor with a constant torque.
            slipping_velocity_rad_s = self._compute_rotor_velocities(
                motor_torque_nm - tooth_torque_nm, np.zeros(len(tooth_torque_nm))
            )
            rotor_velocity_rad_s = np.where(
                is_slipping, slipping_velocity_rad_s, rotor_velocity_rad_s
            )
        self._rotor_velocity_rad_s = rotor_velocity_rad_s
        self._rotor_angle_rad = self._rotor_angle_rad + step_s * rotor_velocity_rad_s
        self._tooth_torque_nm = tooth_torque_nm
        if is_slipping.any():
            self._let_couplings_slip(is_slipping, link_angle_rad)

    def _compute_rotor_velocities(self, torque_nm: Floats, implicit_inertia: Floats) -> Floats:
        """Return the velocities of the rotors at the end of a step.

            (inertia + step * viscous + implicit inertia) * change = step * (torque - viscous * velocity)

        Args:
            torque_nm: Torque on each rotor besides its friction.
            implicit_inertia: Part of the inertia that makes the step implicit in spring and damper of the teeth, kg·m².
        """
        viscous_damping = self._viscous_damping_nm_s_per_rad
        effective_inertia = (
            self._rotor_inertia_kg_m2 + self.step_s * viscous_damping + implicit_inertia
        )
        net_torque_nm = torque_nm - viscous_damping * self._rotor_velocity_rad_s
        velocity_rad_s = (
            self._rotor_velocity_rad_s + self.step_s * net_torque_nm / effective_inertia
        )
        max_friction_change_rad_s = self.step_s * self._friction_nm / effective_inertia
        friction_change_rad_s = np.clip(
            velocity_rad_s, -max_friction_change_rad_s, max_friction_change_rad_s
        )
        return velocity_rad_s - friction_change_rad_s

    def _let_couplings_slip(self, is_slipping: NDArray[np.bool_], link_angle_rad: Floats) -> None:
        """Let couplings slip until the spring of the teeth has only the torque at which they slip."""
        direction = np.sign(self._tooth_torque_nm)
        spring_rad = np.abs(self._tooth_torque_nm) / TOOTH_STIFFNESS_NM_PER_RAD
        max_relative_angle_rad = direction * (self._half_backlash_rad + spring_rad)
        excess_rad = (
            self._rotor_angle_rad - link_angle_rad - self._slipped_rad - max_relative_angle_rad
        )
        excess_rad = np.where(is_slipping, excess_rad, 0.0)
        # Damping may exceed the torque while the spring does not, and a coupling never slips back.
        self._slipped_rad = self._slipped_rad + np.where(
            excess_rad * direction > 0.0, excess_rad, 0.0
        )

    @property
    def angle_rad(self) -> Floats:
        """Return joint angles as the encoders on the rotors measure them, (n_joints,)."""
        angle_rad = self._physics_model.angle_rad.copy()
        angle_rad[self._loose_joints] = self._rotor_angle_rad
        return angle_rad

    @property
    def velocity_rad_s(self) -> Floats:
        """Return joint velocities as the encoders on the rotors measure them, (n_joints,)."""
        velocity_rad_s = self._physics_model.velocity_rad_s.copy()
        velocity_rad_s[self._loose_joints] = self._rotor_velocity_rad_s
        return velocity_rad_s

    def shaft_torque_nm(self) -> Floats:
        """Return the torque through each joint's shaft; behind a loose gear, that of its teeth."""
        torque_nm = self._physics_model.shaft_torque_nm().copy()
        torque_nm[self._loose_joints] = self._tooth_torque_nm
        return torque_nm

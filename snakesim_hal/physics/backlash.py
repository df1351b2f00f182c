"""A physics model whose drives reach some of its links through gears with backlash, for emulated drives.

An encoder on the motor's side of such a gear rotates through the backlash at each reversal, while the link stays where
it is. The rotor of such a joint therefore has an angle of its own:

    rotor_inertia * rotor_acceleration = motor torque - rotor friction - tooth torque

The tooth torque acts on the link. It is 0 while the teeth are apart, and that of a stiff, damped spring otherwise.
"""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Joint, JointExceptions
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.physics_model import LinkLoad, PhysicsModel
from snakesim_hal.wire.messages import Imu, Pose

# Softer than most gears; an explicit step of 1 ms integrates it on a light link.
TOOTH_STIFFNESS_NM_PER_RAD = 300.0
TOOTH_DAMPING_NM_S_PER_RAD = 0.3  # teeth hardly rebound
LINK_SIDE_INERTIA_RATIO = 0.1  # of the rotor's inertia: the gear's output stage stays on the link
MIN_ROTOR_INERTIA_KG_M2 = 1e-4  # a rotor without inertia could not be integrated


def move_rotor_inertia_to_motor_side(
    config: RunConfig, joints: Sequence[Joint], backlash_rad: Mapping[str, float]
) -> RunConfig:
    """Return a configuration in which joints with backlash have no friction and only a part of their rotor inertia.

    The physics model of the links is made from it. `BacklashModel` simulates the rotors of these joints itself.

    Args:
        config: Configuration of the run.
        joints: Every joint with its true (not nominal) parameters, tail to head.
        backlash_rad: Total backlash, peak to peak, by joint name.
    """
    exceptions = dict(config.robot.joints)
    for joint in joints:
        if joint.name not in backlash_rad:
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


class BacklashModel(PhysicsModel):
    """Wraps another physics model. Its joint angles are those that encoders on the rotors measure."""

    def __init__(
        self,
        physics_model: PhysicsModel,
        joints: Sequence[Joint],
        backlash_rad: Mapping[str, float],
        seed: int,
    ) -> None:
        """Place every rotor at a random angle within its backlash, at rest.

        Args:
            physics_model: Model of the links. It is made from the configuration that `move_rotor_inertia_to_motor_side`
                of this module returns, so that the inertia and the friction of these rotors are not simulated twice.
            joints: Every joint with its true (not nominal) parameters, tail to head.
            backlash_rad: Total backlash, peak to peak, by joint name. Joints that are missing have none.
            seed: Seed of the random start angles of the rotors.
        """
        self._physics_model = physics_model
        self.step_s = physics_model.step_s

        # Indices and rotor parameters of the joints with backlash. Every array has one entry for each of these joints.
        backlash_joints = [i for i, joint in enumerate(joints) if joint.name in backlash_rad]
        motors = [joints[i].motor for i in backlash_joints]
        self._backlash_joints = np.array(backlash_joints, dtype=np.intp)
        self._half_backlash_rad: Floats = np.array(
            [backlash_rad[joints[i].name] / 2 for i in backlash_joints]
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
        offset_rad = rng.uniform(-1.0, 1.0, len(backlash_joints)) * self._half_backlash_rad
        self._rotor_angle_rad: Floats = physics_model.angle_rad[self._backlash_joints] + offset_rad
        self._rotor_velocity_rad_s: Floats = np.zeros(len(backlash_joints))
        self._tooth_torque_nm: Floats = np.zeros(len(backlash_joints))

    def advance(self, torque_nm: Floats) -> None:
        """Advance rotors and links by `step_s` under these motor torques."""
        self._advance_rotors(torque_nm[self._backlash_joints])
        link_torque_nm = torque_nm.copy()
        link_torque_nm[self._backlash_joints] = self._tooth_torque_nm
        self._physics_model.advance(link_torque_nm)

    def _advance_rotors(self, motor_torque_nm: Floats) -> None:
        """Advance the angles, velocities and tooth torques of the rotors by a step, at constant velocity of the links.

        The step is implicit in the spring and the damper of the teeth, and in the viscous friction. Coulomb friction
        is applied afterwards, and at most stops the rotor.

        Args:
            motor_torque_nm: Motor torques of the joints with backlash.
        """
        step_s = self.step_s
        link_angle_rad = self._physics_model.angle_rad[self._backlash_joints]
        link_velocity_rad_s = self._physics_model.velocity_rad_s[self._backlash_joints]

        # The teeth touch where the angle between rotor and link is larger than half of the backlash.
        separation_rad = self._rotor_angle_rad - link_angle_rad
        penetration_rad = separation_rad - np.clip(
            separation_rad, -self._half_backlash_rad, self._half_backlash_rad
        )
        is_touching = penetration_rad != 0.0
        stiffness = np.where(is_touching, TOOTH_STIFFNESS_NM_PER_RAD, 0.0)
        damping = np.where(is_touching, TOOTH_DAMPING_NM_S_PER_RAD, 0.0)

        # Velocity: (inertia + step (viscous + damping) + step² stiffness) * change = step * net torque.
        slip_rad_s = self._rotor_velocity_rad_s - link_velocity_rad_s
        net_torque_nm = (
            motor_torque_nm - self._viscous_damping_nm_s_per_rad * self._rotor_velocity_rad_s
        )
        net_torque_nm = (
            net_torque_nm
            - stiffness * (penetration_rad + step_s * slip_rad_s)
            - damping * slip_rad_s
        )
        effective_inertia = (
            self._rotor_inertia_kg_m2
            + step_s * (self._viscous_damping_nm_s_per_rad + damping)
            + step_s**2 * stiffness
        )
        self._rotor_velocity_rad_s = (
            self._rotor_velocity_rad_s + step_s * net_torque_nm / effective_inertia
        )
        max_friction_change_rad_s = step_s * self._friction_nm / effective_inertia
        self._rotor_velocity_rad_s = self._rotor_velocity_rad_s - np.clip(
            self._rotor_velocity_rad_s, -max_friction_change_rad_s, max_friction_change_rad_s
        )
        self._rotor_angle_rad = self._rotor_angle_rad + step_s * self._rotor_velocity_rad_s

        # Torque on the links at the end of the step.
        slip_rad_s = self._rotor_velocity_rad_s - link_velocity_rad_s
        tooth_torque_nm = stiffness * (penetration_rad + step_s * slip_rad_s)
        tooth_torque_nm = tooth_torque_nm + damping * slip_rad_s
        is_pushing = tooth_torque_nm * penetration_rad > 0.0  # teeth do not pull
        self._tooth_torque_nm = np.where(is_pushing, tooth_torque_nm, 0.0)

    @property
    def angle_rad(self) -> Floats:
        """Return joint angles as the encoders on the rotors measure them, (n_joints,)."""
        angle_rad = self._physics_model.angle_rad.copy()
        angle_rad[self._backlash_joints] = self._rotor_angle_rad
        return angle_rad

    @property
    def velocity_rad_s(self) -> Floats:
        """Return joint velocities as the encoders on the rotors measure them, (n_joints,)."""
        velocity_rad_s = self._physics_model.velocity_rad_s.copy()
        velocity_rad_s[self._backlash_joints] = self._rotor_velocity_rad_s
        return velocity_rad_s

    def shaft_torque_nm(self) -> Floats:
        """Return the torque through each joint's shaft; behind a gear with backlash, that of its teeth."""
        torque_nm = self._physics_model.shaft_torque_nm()
        torque_nm[self._backlash_joints] = self._tooth_torque_nm
        return torque_nm

    def loads(self) -> list[LinkLoad]:
        return self._physics_model.loads()

    def imu(self) -> Imu | None:
        return self._physics_model.imu()

    def pose(self) -> Pose | None:
        return self._physics_model.pose()

"""How emulated drives are really mounted and built: as in the robot file, unless a backend's settings differ.

With such settings a test, or an operator, can see the effect of a robot file that is wrong.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.joints import (
    Backlash,
    DeadZone,
    Friction,
    Gear,
    Joint,
    JointDrive,
    JointExceptions,
    JointMotor,
    Lag,
    RotorInertia,
    Sign,
    SlipTorque,
    TorqueConstant,
    Viscosity,
    Zero,
)
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig


class MountedDrive(FileStruct, frozen=True, kw_only=True):
    """How an emulated drive is really mounted and built, where that differs from the robot file.

    A driver type may add fields of its own in a subclass.
    """

    sign: Sign | None = None
    """1 or -1, whether the emulated drive rotates with or against the joint. None: as in the robot file."""

    zero_rad: Zero | None = None
    """Angle that the emulated drive measures at the joint's zero. None: as in the robot file."""

    gear: Gear | None = None
    """Revolutions of the drive's shaft for each revolution of the joint. None: as in the robot file."""

    friction_nm: Friction | None = None
    """Coulomb friction of motor and gear. None: as in the robot file."""

    viscous_nm_s_per_rad: Viscosity | None = None
    """Viscous friction of motor and gear. None: as in the robot file."""

    armature_kg_m2: RotorInertia | None = None
    """Inertia of the rotor, as seen at the joint. None: as in the robot file."""

    response_time_s: Lag | None = None
    """Time constant with which the torque follows its command. None: as in the robot file."""

    torque_constant_nm_per_a: TorqueConstant | None = None
    """Torque for each ampere at the drive's shaft. None: as in the robot file.

    The drive computes torque and current with the constant of the robot file, so its torque is wrong by the ratio of
    the two. It has no effect if the robot file has no constant.
    """

    backlash_rad: Backlash | None = None
    """Whole backlash of the gear, between the encoder on the motor and the link. None: no backlash."""

    coupling_slip_nm: SlipTorque | None = None
    """Torque of the joint at which the coupling between gear and link slips. None: it does not slip."""

    encoder_dead_zone_rad: DeadZone | None = None
    """Motion of the joint by which the angle of its encoder lags, before it jumps to the shaft. None: no dead zone."""


def build_actual_joints(robot: RobotFile, mounted: Mapping[str, MountedDrive]) -> list[Joint]:
    """Return every joint with the drive and motor that are really mounted, from tail to head.

    Args:
        robot: The robot as its file describes it.
        mounted: Differences between the real mounting and the robot file, by the name of the joint.
    """
    joints = robot.joint_table
    for i, joint in enumerate(joints):
        true_mounting = mounted.get(joint.name)
        if true_mounting is not None:
            drive = msgspec.structs.replace(
                joint.drive, **_collect_overrides(true_mounting, JointDrive)
            )
            motor = msgspec.structs.replace(
                joint.motor, **_collect_overrides(true_mounting, JointMotor)
            )
            joints[i] = dataclasses.replace(joint, drive=drive, motor=motor)
    return joints


def build_actual_config(config: RunConfig, mounted: Mapping[str, MountedDrive]) -> RunConfig:
    """Return the configuration for the physics model that the drives move, with the motors that are really mounted.

    Args:
        config: Configuration of the run, with the robot as its file describes it.
        mounted: Differences between the real mounting and the robot file, by the name of the joint.
    """
    joints = dict(config.robot.joints)
    for name, true_mounting in mounted.items():
        overrides = _collect_overrides(true_mounting, JointMotor)
        if overrides:
            exceptions = joints.get(name, JointExceptions())
            joints[name] = msgspec.structs.replace(exceptions, **overrides)
    robot = msgspec.structs.replace(config.robot, joints=joints)
    return msgspec.structs.replace(config, robot=robot)


def compute_torque_ratios(robot: RobotFile, mounted: Mapping[str, MountedDrive]) -> list[float]:
    """Return the real torque of each drive divided by the torque that it computes from its current, tail to head.

    A drive, or its driver, computes torques with the torque constant of the robot file. Without one, it computes the
    real torque.

    Args:
        robot: The robot as its file describes it.
        mounted: Differences between the real mounting and the robot file, by the name of the joint.
    """
    ratios: list[float] = []
    for joint in robot.joint_table:
        assumed_nm_per_a = joint.motor.torque_constant_nm_per_a
        true_nm_per_a = mounted.get(joint.name, MountedDrive()).torque_constant_nm_per_a
        if assumed_nm_per_a is None or true_nm_per_a is None:
            ratios.append(1.0)
        else:
            ratios.append(true_nm_per_a / assumed_nm_per_a)
    return ratios


def _collect_overrides(
    true_mounting: MountedDrive, section: type[JointDrive | JointMotor]
) -> dict[str, Any]:
    """Return the true values of those fields of `JointDrive` or `JointMotor` that differ from the robot file."""
    common_fields = {*section.__struct_fields__} & {*MountedDrive.__struct_fields__}
    true_values = msgspec.structs.asdict(true_mounting)
    return {
        field: value
        for field, value in true_values.items()
        if field in common_fields and value is not None
    }


def validate_mounting_overrides(
    robot: RobotFile, section: str, mounted: Mapping[str, MountedDrive], *, are_emulated: bool
) -> None:
    """Check the settings that override the mounting of drives in the robot file, for emulated drives.

    Args:
        robot: The robot as its file describes it.
        section: Dotted name of the settings section, used in error messages.
        mounted: Differences between the real mounting of drives and the robot file, by the name of the joint.
        are_emulated: Whether this process emulates the drives.

    Raises:
        ConfigError: A joint does not exist, or there are overrides although the drives are not emulated.
    """
    joint_names = [joint.name for joint in robot.joint_table]  # from tail to head, joint_1 first
    for name in mounted:
        if name not in joint_names:
            raise ConfigError(
                f"`{section}.mounted.{name}`: robot {robot.name!r} has {joint_names[0]} to {joint_names[-1]}",
                code="config/conflict",
            )
    if mounted and not are_emulated:
        raise ConfigError(
            f"`{section}.mounted` is for emulators; the modules on this bus are mounted as they are",
            code="config/conflict",
        )

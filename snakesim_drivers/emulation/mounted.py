"""How emulated drives are really mounted and built: as in the robot file, unless a backend's settings differ.

With such settings a test, or an operator, can see the effect of a robot file that is wrong.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import (
    Backlash,
    Drive,
    Friction,
    Gear,
    Joint,
    JointExceptions,
    Lag,
    Motor,
    RotorInertia,
    Sign,
    TorqueConstant,
    Viscosity,
    Zero,
)
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig


class Mounted(FileStruct, frozen=True, kw_only=True):
    """How an emulated drive is really mounted and built, where that differs from the robot file.

    A driver type may add fields of its own in a subclass.
    """

    sign: Sign | None = None
    """1 or -1, whether the emulated drive rotates with or against the joint; none: as in the robot file."""

    zero_rad: Zero | None = None
    """Angle that the emulated drive measures at the joint's zero; none: as in the robot file."""

    gear: Gear | None = None
    """Revolutions of the drive's shaft for each revolution of the joint; none: as in the robot file."""

    friction_nm: Friction | None = None
    """Coulomb friction of motor and gear; none: as in the robot file."""

    viscous_nm_s_per_rad: Viscosity | None = None
    """Viscous friction of motor and gear; none: as in the robot file."""

    armature_kg_m2: RotorInertia | None = None
    """Inertia of the rotor, as seen at the joint; none: as in the robot file."""

    response_time_s: Lag | None = None
    """Time constant with which the torque follows its command; none: as in the robot file."""

    torque_constant_nm_per_a: TorqueConstant | None = None
    """Torque for each ampere at the drive's shaft; none: as in the robot file."""

    backlash_rad: Backlash | None = None
    """Whole backlash of the gear, between the encoder on the motor and the link; none: no backlash."""


def build_joints(robot: RobotFile, mounted: Mapping[str, Mounted]) -> list[Joint]:
    """Return every joint with its drive and motor as they are in truth, from tail to head.

    Args:
        robot: The robot as its file describes it.
        mounted: What differs, by the name of the joint.
    """
    joints = robot.joint_table
    for i, joint in enumerate(joints):
        truth = mounted.get(joint.name)
        if truth is not None:
            drive = msgspec.structs.replace(joint.drive, **_list_differences(truth, Drive))
            motor = msgspec.structs.replace(joint.motor, **_list_differences(truth, Motor))
            joints[i] = dataclasses.replace(joint, drive=drive, motor=motor)
    return joints


def build_config(config: RunConfig, mounted: Mapping[str, Mounted]) -> RunConfig:
    """Return the configuration of the physics model that the drives move: with motors as they are in truth.

    Args:
        config: Configuration of the run, with the robot and the settings of its backend.
        mounted: What differs, by the name of the joint.
    """
    joints = dict(config.robot.joints)
    for name, truth in mounted.items():
        differences = _list_differences(truth, Motor)
        if differences:
            exceptions = joints.get(name, JointExceptions())
            joints[name] = msgspec.structs.replace(exceptions, **differences)
    robot = msgspec.structs.replace(config.robot, joints=joints)
    return msgspec.structs.replace(config, robot=robot)


def _list_differences(truth: Mounted, section: type[Drive | Motor]) -> dict[str, Any]:
    """Return the fields of a section that differ from the robot file, with their true values."""
    common_fields = {*section.__struct_fields__} & {*Mounted.__struct_fields__}
    true_values = msgspec.structs.asdict(truth)
    return {field: value for field, value in true_values.items() if field in common_fields and value is not None}


def check_mounted(robot: RobotFile, section: str, mounted: Mapping[str, Mounted], *, emulators: bool) -> None:
    """Check the settings that mount emulated drives otherwise than the robot file describes.

    Args:
        robot: The robot as its file describes it.
        section: Section of the settings, for messages.
        mounted: The differences from the robot file, by the name of the joint.
        emulators: Whether this process emulates the drives.

    Raises:
        ConfigError: The robot does not have such a joint, or the drives are not emulated here.
    """
    names = [joint.name for joint in robot.joint_table]
    for name in mounted:
        if name not in names:
            raise ConfigError(
                f"`{section}.mounted.{name}`: robot {robot.name!r} has {names[0]} to {names[-1]}",
                code="config/conflict",
            )
    if mounted and not emulators:
        raise ConfigError(
            f"`{section}.mounted` is for emulators; the modules on this bus are mounted as they are",
            code="config/conflict",
        )

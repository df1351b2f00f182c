"""How emulated drives are mounted and built in truth: as the robot file says, but for what a backend's settings say.

So a test, or a curious person, sees what a wrong robot file does.
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
    """How an emulated module is really mounted and built, where that is not what the robot file says."""

    sign: Sign | None = None
    zero_rad: Zero | None = None
    gear: Gear | None = None
    friction_nm: Friction | None = None
    viscous_nm_s_per_rad: Viscosity | None = None
    armature_kg_m2: RotorInertia | None = None
    response_time_s: Lag | None = None
    torque_constant_nm_per_a: TorqueConstant | None = None
    # Whole play of its gear, between the encoder on the motor and the link. A robot file has none.
    backlash_rad: Backlash | None = None


def build_joints(robot: RobotFile, mounted: Mapping[str, Mounted]) -> list[Joint]:
    """Every joint with its drive and motor as they are in truth, tail to head."""
    joints = robot.joint_table
    for i, joint in enumerate(joints):
        truth = mounted.get(joint.name)
        if truth is not None:
            drive = msgspec.structs.replace(joint.drive, **_said(truth, Drive))
            motor = msgspec.structs.replace(joint.motor, **_said(truth, Motor))
            joints[i] = dataclasses.replace(joint, drive=drive, motor=motor)
    return joints


def build_config(config: RunConfig, mounted: Mapping[str, Mounted]) -> RunConfig:
    """The run's configuration for the physics model that the drives move: with their motors as they are in truth."""
    joints = dict(config.robot.joints)
    for name, truth in mounted.items():
        if differs := _said(truth, Motor):
            joints[name] = msgspec.structs.replace(joints.get(name, JointExceptions()), **differs)
    return msgspec.structs.replace(config, robot=msgspec.structs.replace(config.robot, joints=joints))


def _said(truth: Mounted, section: type[Drive | Motor]) -> dict[str, Any]:
    """What is known to be otherwise in a section; a driver type may add fields of its own to both."""
    fields = set(section.__struct_fields__) & set(Mounted.__struct_fields__)
    said = {field: getattr(truth, field) for field in fields}
    return {field: value for field, value in said.items() if value is not None}


def check_mounted(robot: RobotFile, section: str, mounted: Mapping[str, Mounted], *, emulators: bool) -> None:
    """Raise ConfigError for joints that the robot does not have, and for drives that are not emulated here."""
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

"""How emulated drives are mounted in truth: as the robot file says, but for what a backend's settings say otherwise.

So a test, or a curious person, sees what a wrong robot file does.
"""

import dataclasses
from collections.abc import Mapping

import msgspec

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Gear, Joint, Sign, Zero
from snakesim_hal.model.robot import RobotFile


class Mounted(FileStruct, frozen=True, kw_only=True):
    """How an emulated module is really mounted, where that is not what the robot file says."""

    sign: Sign | None = None
    zero_rad: Zero | None = None
    gear: Gear | None = None


def built(robot: RobotFile, mounted: Mapping[str, Mounted]) -> list[Joint]:
    """Every joint with its drive as it is mounted in truth, tail to head."""
    joints = robot.joint_table
    for i, joint in enumerate(joints):
        truth = mounted.get(joint.name)
        if truth is not None:
            said = {field: getattr(truth, field) for field in Mounted.__struct_fields__}  # a family may add its own
            differs = {field: value for field, value in said.items() if value is not None}
            joints[i] = dataclasses.replace(joint, drive=msgspec.structs.replace(joint.drive, **differs))
    return joints


def check_mounted(robot: RobotFile, section: str, mounted: Mapping[str, Mounted], *, twins: bool) -> None:
    """Raise ConfigError for joints that the robot does not have, and for drives that are not emulated here."""
    names = [joint.name for joint in robot.joint_table]
    for name in mounted:
        if name not in names:
            raise ConfigError(f"`{section}.mounted.{name}`: robot {robot.name!r} has {names[0]} to {names[-1]}")
    if mounted and not twins:
        raise ConfigError(f"`{section}.mounted` is for twins; the modules on this bus are mounted as they are")

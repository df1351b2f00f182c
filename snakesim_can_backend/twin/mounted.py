"""How emulated modules are mounted: as the robot file says, but for what the settings say is otherwise in truth."""

import dataclasses

import msgspec

from snakesim_can_backend.settings import CanSettings
from snakesim_hal.model.joints import Drive, Joint
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.wire.messages import Mode


def built(robot: RobotFile, settings: CanSettings) -> list[Joint]:
    """Every joint with its module as it is mounted in truth, tail to head."""
    joints = robot.joint_table
    for i, joint in enumerate(joints):
        truth = settings.mounted.get(joint.name)
        if truth is not None:
            differs = {field: value for field, value in msgspec.structs.asdict(truth).items() if value is not None}
            joints[i] = dataclasses.replace(joint, drive=msgspec.structs.replace(joint.drive, **differs))
    return joints


def joint_target(drive: Drive, mode: Mode, target: float) -> float:
    """What a target of a module's shaft is at the joint, in the mode's unit."""
    turns = drive.sign * drive.gear
    match mode:
        case Mode.POSITION:
            return (target - drive.zero_rad) / turns
        case Mode.VELOCITY:
            return target / turns
        case Mode.TORQUE:
            return target * turns
        case Mode.PASSIVE:
            return 0.0

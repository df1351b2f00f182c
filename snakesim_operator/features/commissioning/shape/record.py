"""Writes the properties that drawn shapes confirmed into the robot file, and reads which of them are still valid."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.checked import (
    PROPERTIES,
    JointProperty,
    StartCheckRecord,
    find_change_since_check,
)
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.features.commissioning.robot_edit import (
    make_check_record,
    write_check_record,
)
from snakesim_operator.features.commissioning.shape.decide import SHAPE_PROPERTIES


@dataclass(frozen=True)
class ShapeEvidence:
    """What drawn shapes and a person who shook the links have confirmed, and is still valid."""

    properties: Sequence[JointProperty] = ()  # of every joint; of the gear, only its ratio
    shaken_joints: Sequence[str] = ()  # whose link does not move before its drive


def write_shape_record(
    path: Path, joints: Sequence[Joint], robot: RobotDescription, shaken_joints: Sequence[str]
) -> None:
    """Write into a robot file that drawn shapes confirmed order, sign, gear and zero of every joint.

    The gear counts as confirmed only if a person has shaken every link as well, because shapes show only its ratio. A
    robot whose drives are emulated gets no record. Properties of an earlier check that is still valid stay.

    Args:
        path: Path of the robot file.
        joints: Joints of the file, with the modes that their drives have.
        robot: Description of the robot, with the serial numbers of its drives.
        shaken_joints: Joints whose link a person shook, and found that it does not move before its drive.

    Raises:
        ConfigError: The file cannot be written.
    """
    if robot.emulated:
        print_line(f"{path}: nothing was written: the drives are emulated, and need no check")
        return
    confirmed: set[JointProperty] = {
        *SHAPE_PROPERTIES,
        *_read_confirmed_properties(path, joints, robot),
    }
    if len(shaken_joints) < len(joints):
        confirmed.discard("gear")
    record = msgspec.structs.replace(
        make_check_record(joints, robot, [name for name in PROPERTIES if name in confirmed]),
        by_shape=list(SHAPE_PROPERTIES),
        shaken=list(shaken_joints),
    )
    write_check_record(path, record)
    missing = [name for name in PROPERTIES if name not in confirmed]
    if missing:
        recorded = [name for name in SHAPE_PROPERTIES if name in confirmed]
        print_line(
            f"{path}: {', '.join(recorded)} recorded. To confirm {', '.join(missing)}, restart the host, make "
            f"a run with `snakesim run joint_check`, and judge it with `snakesim robot check RUN --write {path}`"
        )
    else:
        print_line(f"{path}: checked by {record.by} on {record.on}; restart the host with it")


def read_shape_evidence(
    path: Path, joints: Sequence[Joint], robot: RobotDescription
) -> ShapeEvidence:
    """Return what drawn shapes confirmed; nothing if the mounting or a drive has changed since.

    Args:
        path: Path of the robot file.
        joints: Joints of the robot now.
        robot: Description of the robot, with the serial numbers of its drives now.

    Raises:
        ConfigError: The file cannot be read.
    """
    record = _read_valid_record(path, joints, robot)
    if record is None:
        return ShapeEvidence()
    return ShapeEvidence(record.by_shape, record.shaken)


def _read_confirmed_properties(
    path: Path, joints: Sequence[Joint], robot: RobotDescription
) -> list[JointProperty]:
    record = _read_valid_record(path, joints, robot)
    return list(record.confirmed) if record is not None else []


def _read_valid_record(
    path: Path, joints: Sequence[Joint], robot: RobotDescription
) -> StartCheckRecord | None:
    """Return the record of the last check, unless the mounting of a joint or a drive has changed since."""
    record = decode_table(read_table_with_base(str(path), "robots"), RobotFile).checked
    if record is None or find_change_since_check(record, joints, robot):
        return None
    return record

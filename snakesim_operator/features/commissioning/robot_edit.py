"""Changes single values of a robot file, and leaves its comments and its order as they are."""

import dataclasses
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import msgspec
import tomlkit
from tomlkit.items import Table

from snakesim_hal.base.atomic_write import write_atomically, write_through
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.model.files import decode_table, read_table_with_base, resolve_file_path
from snakesim_hal.model.robot_file.checked import (
    JointProperty,
    StartCheckRecord,
    compute_mounting_digest,
)
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.robot_file.robot import RobotFile, list_serial_numbers
from snakesim_hal.model.textfiles import read_text
from snakesim_hal.wire.messages import RobotDescription


def require_own_robot_file(path: Path) -> None:
    """Raise ConfigError if a path names a robot file that is shipped with SnakeSIM, which must not be changed."""
    if resolve_file_path(str(path), "robots") != path:
        raise ConfigError(
            f"{path}: give the path of your own robot file, such as ./{path}.toml; shipped ones stay",
            code="commissioning/not-possible",
        )


def read_joints_with_drive_modes(path: Path, running: Sequence[Joint]) -> list[Joint]:
    """Read the joints of a robot file, without the modes and measurements that the drives of the host do not have.

    Args:
        path: Path of the robot file.
        running: Joints of the running host; its backend leaves out what its drives do not have.

    Returns:
        The joints of the file, tail to head.

    Raises:
        ConfigError: The file cannot be read, or is invalid.
    """
    joints = decode_table(read_table_with_base(str(path), "robots"), RobotFile).joint_table
    for i, (in_file, on_host) in enumerate(zip(joints, running, strict=False)):
        modes = [mode for mode in in_file.drive.modes if mode in on_host.drive.modes]
        measures = [
            quantity for quantity in in_file.drive.measures if quantity in on_host.drive.measures
        ]
        drive = msgspec.structs.replace(
            in_file.drive, modes=modes or in_file.drive.modes, measures=measures
        )
        joints[i] = dataclasses.replace(in_file, drive=drive)
    return joints


def write_joint_fields(path: Path, values: dict[str, dict[str, Any]], origin: str) -> None:
    """Write fields of `[joints.NAME]` into a robot file, each with a comment about how its value was found.

    Args:
        path: Path of the robot file.
        values: New value by field name, by joint name; numbers are rounded to 5 decimals.
        origin: How the values were found; user and date are added.

    Raises:
        ConfigError: The file cannot be changed; then it is as it was.
    """
    document = tomlkit.parse(read_text(path))
    joints = _get_or_add_section(document, "joints", super_table=True)
    comment = f"{origin}, {get_user_name()}, {date.today().isoformat()}"
    for name, fields in values.items():
        section = _get_or_add_section(joints, name, super_table=False)
        for field, value in fields.items():
            rounded = round(value, 5) if isinstance(value, float) else value
            item = tomlkit.item(rounded)
            item.comment(comment)
            section[field] = item
    _validate_and_replace_file(path, document)


def make_check_record(
    joints: Sequence[Joint], robot: RobotDescription, confirmed: Sequence[JointProperty]
) -> StartCheckRecord:
    """Return the record of a check that this user has made today.

    Args:
        joints: Joints of the robot file, with the modes that their drives have.
        robot: Description of the robot, with the serial numbers of its drives.
        confirmed: Properties that are confirmed for every joint.
    """
    return StartCheckRecord(
        by=get_user_name(),
        on=date.today().isoformat(),
        joints=compute_mounting_digest(joints),
        backend=robot.backend,
        hardware=robot.hardware,
        serials=list_serial_numbers(robot),
        confirmed=list(confirmed),
    )


def write_check_record(path: Path, checked: StartCheckRecord) -> None:
    """Write the section `[checked]` of a robot file. If this raises ConfigError, the file is as it was."""
    document = tomlkit.parse(read_text(path))
    section = tomlkit.table()
    section.comment(
        "written by `snakesim robot check`; it counts until the joints above or their drives change"
    )
    for name, value in msgspec.to_builtins(checked).items():
        if value:
            section[name] = value
    document["checked"] = section
    _validate_and_replace_file(path, document)


def _validate_and_replace_file(path: Path, document: tomlkit.TOMLDocument) -> None:
    """Replace a robot file after a check that its new content can be read. If this raises, the file is as it was."""
    content = tomlkit.dumps(document).encode()
    # The candidate is in the same folder, because `extends` may name a file relative to it.
    candidate = path.with_name(f".{path.name}")
    try:
        write_atomically(candidate, content)
        decode_table(read_table_with_base(str(candidate), "robots"), RobotFile)
        write_through(path, content, durable=True)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror}; it is as it was. Correct that, and repeat the command",
            code="file/not-writable",
        ) from None
    finally:
        candidate.unlink(missing_ok=True)


def _get_or_add_section(parent: Any, name: str, *, super_table: bool) -> Any:
    """Return a section of a table, and add it if it is missing. Raises ConfigError if it is written within one line."""
    if name not in parent:
        parent[name] = tomlkit.table(is_super_table=super_table)
    section = parent[name]
    if not isinstance(section, Table):
        raise ConfigError(
            f"`{name}` is written within one line: write it as a section, [joints.{name}]"
        )
    return section

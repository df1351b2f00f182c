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
from snakesim_hal.model.checked import StartCheckRecord
from snakesim_hal.model.files import decode, find_file, read_part
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.textfiles import read_text


def must_be_own(path: Path) -> None:
    """Raise ConfigError for a robot file that is shipped."""
    if find_file(str(path), "robots") != path:
        raise ConfigError(
            f"{path}: give the path of your own robot file, such as ./{path}.toml; shipped ones stay",
            code="commissioning/not-possible",
        )


def joints_on_drives(path: Path, running: Sequence[Joint]) -> list[Joint]:
    """Return the joints of a robot file with the modes that their drives have, which may be fewer. Raises ConfigError.

    Args:
        path: robot file.
        running: the joints of a host; its backend leaves out the modes that its drives do not have.
    """
    joints = decode(read_part(str(path), "robots"), RobotFile).joint_table
    for i, (in_file, on_host) in enumerate(zip(joints, running, strict=False)):
        modes = [mode for mode in in_file.drive.modes if mode in on_host.drive.modes]
        drive = msgspec.structs.replace(in_file.drive, modes=modes or in_file.drive.modes)
        joints[i] = dataclasses.replace(in_file, drive=drive)
    return joints


def change_joints(path: Path, values: dict[str, dict[str, Any]], origin: str) -> None:
    """Set fields of `[joints.NAME]`, each with a comment on its origin. Raises ConfigError; then nothing changed.

    Args:
        path: robot file.
        values: joint -> field -> value.
        origin: how the values were found; user and date are added.
    """
    document = tomlkit.parse(read_text(path))
    joints = _get_section(document, "joints", super_table=True)
    comment = f"{origin}, {get_user_name()}, {date.today().isoformat()}"
    for name, fields in values.items():
        section = _get_section(joints, name, super_table=False)
        for field, value in fields.items():
            rounded = round(value, 5) if isinstance(value, float) else value
            item = tomlkit.item(rounded)
            item.comment(comment)
            section[field] = item
    _replace_file(path, document)


def write_checked(path: Path, checked: StartCheckRecord) -> None:
    """Write the section `[checked]` of a robot file. Raises ConfigError; then nothing changed."""
    document = tomlkit.parse(read_text(path))
    section = tomlkit.table()
    section.comment("written by `snakesim robot check`; it counts until the joints above or their drives change")
    for name, value in msgspec.to_builtins(checked).items():
        if value:
            section[name] = value
    document["checked"] = section
    _replace_file(path, document)


def _replace_file(path: Path, document: tomlkit.TOMLDocument) -> None:
    """Replace a robot file, once its new content could be read. Raises ConfigError; then nothing changed."""
    content = tomlkit.dumps(document).encode()
    # The candidate is in the same folder, because `extends` may name a file relative to it.
    candidate = path.with_name(f".{path.name}")
    try:
        write_atomically(candidate, content)
        decode(read_part(str(candidate), "robots"), RobotFile)
        write_through(path, content, durable=True)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror}; it is as it was. Correct that, and repeat the command",
            code="file/not-writable",
        ) from None
    finally:
        candidate.unlink(missing_ok=True)


def _get_section(parent: Any, name: str, *, super_table: bool) -> Any:
    """Return a section, which is made if it is missing. Raises ConfigError if it is written within one line."""
    if name not in parent:
        parent[name] = tomlkit.table(is_super_table=super_table)
    section = parent[name]
    if not isinstance(section, Table):
        raise ConfigError(f"`{name}` is written within one line: write it as a section, [joints.{name}]")
    return section

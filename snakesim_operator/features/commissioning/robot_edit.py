"""Changes single values of a robot file, and leaves its comments and its order as they are."""

import dataclasses
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import msgspec
import tomlkit
from tomlkit.items import Table

from snakesim_hal.base.atomic_write import write_through, write_whole
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import user_name
from snakesim_hal.model.checked import Checked
from snakesim_hal.model.files import decode, find, read_part
from snakesim_hal.model.joints import Joint
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.textfiles import read_text


def must_be_own(path: Path) -> None:
    """Raise ConfigError for a robot file that is shipped."""
    if find(str(path), "robots") != path:
        raise ConfigError(f"{path}: give the path of your own robot file, such as ./{path}.toml; shipped ones stay")


def joints_on_drives(path: Path, running: Sequence[Joint]) -> list[Joint]:
    """The joints of a robot file with the modes that their drives have, which may be fewer. Raises ConfigError.

    running: those of a host; a backend leaves out modes that its drives do not have.
    """
    joints = decode(read_part(str(path), "robots"), RobotFile).joint_table
    for i, (said, runs) in enumerate(zip(joints, running, strict=False)):
        modes = [mode for mode in said.drive.modes if mode in runs.drive.modes]
        joints[i] = dataclasses.replace(
            said, drive=msgspec.structs.replace(said.drive, modes=modes or said.drive.modes)
        )
    return joints


def change_joints(path: Path, values: dict[str, dict[str, Any]], how: str) -> None:
    """Set fields of `[joints.NAME]`, each with who, when and how beside it. Raises ConfigError; then nothing changed.

    values: joint -> field -> value.
    """
    document = tomlkit.parse(read_text(path))
    joints = _section(document, "joints", super_table=True)
    said = f"{how}, {user_name()}, {date.today().isoformat()}"
    for name, fields in values.items():
        section = _section(joints, name, super_table=False)
        for field, value in fields.items():
            item = tomlkit.item(round(value, 5) if isinstance(value, float) else value)
            item.comment(said)
            section[field] = item
    _replace(path, document)


def write_checked(path: Path, checked: Checked) -> None:
    """Set the section [checked]. Raises ConfigError; then nothing changed."""
    document = tomlkit.parse(read_text(path))
    section = tomlkit.table()
    section.comment("written by `snakesim joints check`; it counts until the joints above or their drives change")
    for name, value in msgspec.to_builtins(checked).items():
        if value:
            section[name] = value
    document["checked"] = section
    _replace(path, document)


def _replace(path: Path, document: tomlkit.TOMLDocument) -> None:
    """Write a robot file once its new content has been read as one. Raises ConfigError; then nothing changed."""
    content = tomlkit.dumps(document).encode()
    candidate = path.with_name(f".{path.name}")  # beside it, as `extends` may name a file from there
    try:
        write_whole(candidate, content)
        decode(read_part(str(candidate), "robots"), RobotFile)
        write_through(path, content, durable=True)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written: {error.strerror}; it is as it was. Correct that, and repeat the command"
        ) from None
    finally:
        candidate.unlink(missing_ok=True)


def _section(within: Any, name: str, *, super_table: bool) -> Any:
    if name not in within:
        within[name] = tomlkit.table(is_super_table=super_table)
    section = within[name]
    if not isinstance(section, Table):
        raise ConfigError(f"`{name}` is written within one line: write it as a section, [joints.{name}]")
    return section

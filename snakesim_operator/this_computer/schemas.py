"""Writes the published wire contract into `schemas/`: generated from the code, so that both agree."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fields.json_schema import make_schema
from snakesim_hal.model.files import SCHEMAS_DIR
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, FILES, PHYSICS_MODELS
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_hal.model.textfiles import read_text, write_text
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import format_encoding
from snakesim_hal.wire.messages import VERSIONS
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.this_computer.plugin_sections import find_bundled_plugins, get_section_type
from snakesim_operator.this_computer.roles_page import make_roles_page

KEY_SPACE_FILENAME, KEY_SPACE_TITLE = "keys.md", "# Key space"
JSON_SCHEMA_DIALECT = "https://json-schema.org/draft/2020-12/schema"


def list_published_files() -> list[Path]:
    """Return the paths of all installed files of the wire contract, including the DBC file of the CAN bus."""
    return sorted(path for path in SCHEMAS_DIR.rglob("*") if path.is_file())


def write_schemas(folder: Path) -> list[Path]:
    """Write all files of the wire contract into a folder.

    Files of an earlier call that are no longer part of the contract are removed.

    Returns:
        The paths of the written files.
    """
    contents = dict(generate_contract_files())
    if _is_contract_folder(folder):
        for old in [*folder.glob("messages/*.json"), *folder.glob("files/*.json")]:
            if str(old.relative_to(folder)) not in contents:
                old.unlink()
    for name, text in contents.items():
        write_text(folder / name, text)
    return [folder / name for name in contents]


def _is_contract_folder(folder: Path) -> bool:
    """Return whether a folder was written by `write_schemas`, so that its old files may be removed."""
    try:
        return read_text(folder / KEY_SPACE_FILENAME).startswith(KEY_SPACE_TITLE)
    except ConfigError:
        return False


def generate_contract_files() -> Iterator[tuple[str, str]]:
    """Yield every file of the wire contract, as its relative path and its text."""
    yield KEY_SPACE_FILENAME, _format_key_space_page()
    yield "roles.md", make_roles_page()
    for message in VERSIONS:
        extra = {"encoding": format_encoding(message)}
        yield f"messages/{message.__name__}.json", _format_schema(message, extra)
    yield "files/robot.json", _format_schema(RobotFile)
    yield "files/scene.json", _format_schema(SceneFile)
    yield "files/run.json", _format_schema(RunConfig)
    yield "files/summary.json", _format_schema(RunSummary)
    for name, struct in find_bundled_plugins(FILES):
        yield f"files/{name}.json", _format_schema(struct)
    for group, section in (
        (BACKENDS, "backends"),
        (CONTROLLERS, "control"),
        (PHYSICS_MODELS, "physics_models"),
    ):
        for name, plugin in find_bundled_plugins(group):
            yield f"files/{section}.{name}.json", _format_schema(get_section_type(plugin))


def _format_schema(struct: type[msgspec.Struct], extra: dict[str, Any] | None = None) -> str:
    schema = {"$schema": JSON_SCHEMA_DIALECT, **(extra or {}), **make_schema(struct)}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _format_key_space_page() -> str:
    """Return the page that lists all keys of the key space with their messages and writers, as Markdown."""
    rows = [
        KEY_SPACE_TITLE,
        "",
        "Made by `make schemas` from `snakesim_hal/wire/keys.py`. Keys are relative to the robot's Zenoh namespace.",
        "`*` stands for a service's name, of `hal/host/*` for the id of a host. How to use these keys",
        "is described in [protocol.md](protocol.md).",
        "",
        "| key | message | writer | kind | when | content |",
        "|---|---|---|---|---|---|",
    ]
    for row in keys.SPACE:
        if row.message is None:
            message = "-"
        else:
            name = row.message.__name__
            message = f"[{name}](messages/{name}.json) `{format_encoding(row.message).rpartition(';')[2]}`"
        rows.append(
            f"| `{row.key}` | {message} | {row.writer} | {row.kind} | {row.when} | {row.description} |"
        )
    rows += [
        "",
        "There are four kinds. A *stream* is published regularly, and old samples are useless. A *latched* value is",
        "kept for later subscribers, which must query it. A *query* gets an [Answer](messages/Answer.json).",
        "*Liveliness* is a token that vanishes with its process. A *tick* lasts `RobotDescription.period_ns`.",
        "",
    ]
    return "\n".join(rows)

"""Writes the published wire contract into `schemas/`: generated from the code, so that both agree."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import SCHEMAS
from snakesim_hal.model.json_schema import make_schema
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, FILES, PHYSICS_MODELS
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scene import SceneFile
from snakesim_hal.model.textfiles import read_text, write_text
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import format_encoding
from snakesim_hal.wire.messages import VERSIONS
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.this_computer.plugin_sections import list_shipped_plugins, section_type
from snakesim_operator.this_computer.roles_page import roles_page

KEYS, TITLE = "keys.md", "# Key space"
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def published() -> list[Path]:
    """Every installed file, including the DBC file of the bus."""
    return sorted(path for path in SCHEMAS.rglob("*") if path.is_file())


def write_schemas(folder: Path) -> list[Path]:
    """Write everything; returns the files in order. Files of an earlier call that are no longer written are removed."""
    contents = dict(contract())
    if _is_contract(folder):
        for old in [*folder.glob("messages/*.json"), *folder.glob("files/*.json")]:
            if str(old.relative_to(folder)) not in contents:
                old.unlink()
    for name, text in contents.items():
        write_text(folder / name, text)
    return [folder / name for name in contents]


def _is_contract(folder: Path) -> bool:
    """Whether a folder was written by this command: other folders called `files/` stay unchanged."""
    try:
        return read_text(folder / KEYS).startswith(TITLE)
    except ConfigError:
        return False


def contract() -> Iterator[tuple[str, str]]:
    """Every file of the contract as (relative path, text)."""
    yield KEYS, _key_space()
    yield "roles.md", roles_page()
    for message in VERSIONS:
        extra = {"encoding": format_encoding(message)}
        yield f"messages/{message.__name__}.json", _schema(message, extra)
    yield "files/robot.json", _schema(RobotFile)
    yield "files/scene.json", _schema(SceneFile)
    yield "files/run.json", _schema(RunConfig)
    yield "files/summary.json", _schema(RunSummary)
    for name, struct in list_shipped_plugins(FILES):
        yield f"files/{name}.json", _schema(struct)
    for group, section in ((BACKENDS, "backends"), (CONTROLLERS, "control"), (PHYSICS_MODELS, "physics_models")):
        for name, plugin in list_shipped_plugins(group):
            yield f"files/{section}.{name}.json", _schema(section_type(plugin))


def _schema(struct: type[msgspec.Struct], extra: dict[str, Any] | None = None) -> str:
    schema = {"$schema": DIALECT, **(extra or {}), **make_schema(struct)}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _key_space() -> str:
    """Return the page that lists all keys of the network with their messages and writers, as Markdown."""
    rows = [
        TITLE,
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
        rows.append(f"| `{row.key}` | {message} | {row.writer} | {row.kind} | {row.when} | {row.about} |")
    rows += [
        "",
        "Kinds: a *stream* is published regularly and old samples are useless; a *latched* value is kept for",
        "later subscribers, who must query it; a *query* is answered with an [Answer](messages/Answer.json);",
        "*liveliness* is a token that vanishes with its process. A *tick* lasts `Description.period_ns`.",
        "",
    ]
    return "\n".join(rows)

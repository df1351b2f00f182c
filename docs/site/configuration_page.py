"""Writes docs/reference/configuration.md, every key of every file: `python -m docs.site.configuration_page`."""

from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path

import msgspec
from msgspec import inspect

from snakesim_hal.model.field_docs import FieldDoc, document_fields, type_info_of
from snakesim_hal.model.field_types import alternatives
from snakesim_hal.model.field_words import format_value, item_types
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.json_schema import list_structs
from snakesim_hal.model.plugins import BACKENDS, CONTROLLERS, PHYSICS_MODELS, find_plugin, list_installed
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scene import SceneFile
from snakesim_operator.features.evaluate.suite import Suite
from snakesim_operator.features.lab.lab_file import LabFile
from snakesim_operator.this_computer.scenario_keys import section_type

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"
INTRODUCTION = """# Configuration

Every key of the files that you write, from the code by `make schemas`. `snakesim config SCENARIO --explain KEY` prints
the same for one key, with its value in a scenario and the file or flag that gives it. As JSON Schemas:
[`schemas/files/`](../../schemas/README.md).

* A key that is *required* has no default. The default *none* cannot be written: leave the key out, or remove it with
  `--unset`.
* The unit is also the end of the key's name, such as `_m`, `_rad` or `_nm`. Frames: `_w` is the world frame.
* `[name]` is a table. `[[name]]` is an entry of a list: repeat it for each entry. NAME is a name that you choose.
* A key that a file does not know is an error, with a suggestion.
"""
EXTENDS = (
    'A file with `extends = "NAME"`, the name of a shipped {kind} or the path of a {kind} file, contains only what '
    "differs from that {kind}."
)
SCENARIO = (
    "`robot` and `scene` are the names of files, whose keys are those of a [robot file](#robot-file) and of a "
    "[scene file](#scene-file). With `--set` they follow a dot: `--set robot.limits.torque_nm=5`."
)
FILES: dict[str, tuple[type[msgspec.Struct], str]] = {
    "Robot file": (RobotFile, EXTENDS.format(kind="robot")),
    "Scene file": (SceneFile, EXTENDS.format(kind="scene")),
    "Scenario file": (RunConfig, SCENARIO),
    "Suite file": (
        Suite,
        "A suite is described in [evaluation](../how-to/evaluate-controllers.md#a-suite-of-your-own).",
    ),
    "Lab file": (LabFile, "A lab is described in [a lab](../how-to/lab.md)."),
}
PLUGINS = {
    CONTROLLERS: ("Controllers", "controllers", "The parameters of a controller, in a scenario file."),
    BACKENDS: ("Backends", "backends", "The settings of a backend, in a scenario file."),
    PHYSICS_MODELS: (
        "Physics models",
        "physics_model_settings of",
        "The body that emulated drives move. Its settings are in `physics_model_settings` of a backend.",
    ),
}
OTHER_FILES = (RobotFile, SceneFile)  # of a scenario: they have their own headings
EXCEPTIONS = "Every key of {sections} is also allowed here, except for `ambient_c`. A missing key is as for all joints."


def documented_structs() -> dict[str, type[msgspec.Struct]]:
    """Return the Struct of every kind of file, and of every section that a plugin reads, by its heading."""
    structs = {heading: struct for heading, (struct, _) in FILES.items()}
    for group, (_, section, _) in PLUGINS.items():
        for name in list_installed(group):
            plugin = find_plugin(group, name)
            if plugin.__module__.startswith("snakesim_"):
                structs[f"[{section}.{name}]"] = section_type(plugin)
    return structs


def fields_without_description() -> list[str]:
    """Return class and name of every field that has no description."""
    found: dict[str, None] = {}
    for struct in documented_structs().values():
        for part in list_structs(struct):
            for doc in document_fields(part):
                if not doc.description:
                    found[f"{part.__qualname__}.{doc.name}"] = None
    return list(found)


def make_page() -> str:
    """Return the page as it should be."""
    lines = [INTRODUCTION]
    for heading, (struct, note) in FILES.items():
        lines += [f"## {heading}", "", note, "", *_table(struct), *_inner_tables(struct, ""), ""]
    for group, (heading, section, note) in PLUGINS.items():
        lines += [f"## {heading}", "", note, ""]
        for name in list_installed(group):
            plugin = find_plugin(group, name)
            if not plugin.__module__.startswith("snakesim_"):
                continue
            path = f"{section}.{name}" if group != PHYSICS_MODELS else name
            title = f"`[{path}]`" if group != PHYSICS_MODELS else f"`{name}`"
            lines += [f"### {title}", "", _first_paragraph(section_type(plugin)), "", *_table(section_type(plugin))]
            lines += _inner_tables(section_type(plugin), path)
    text = "\n".join(lines)
    while "\n\n\n" in text:
        text = text.replace("\n\n\n", "\n\n")
    return text.rstrip() + "\n"


def _inner_tables(struct: type[msgspec.Struct], path: str) -> Iterator[str]:
    """Yield heading and table of every Struct inside of a Struct, the outer ones first."""
    for field in type_info_of(struct).fields:
        inner_path = f"{path}.{field.encode_name}" if path else field.encode_name
        for heading, part in _structs_at(field.type, inner_path):
            if part in OTHER_FILES:
                continue
            yield from ["", f"### {heading}", "", _first_paragraph(part), "", *_table(part)]
            yield from _inner_tables(part, heading.strip("`").strip("[]").partition("]")[0])


def _structs_at(info: inspect.Type, path: str) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """Yield the Structs that a field holds, each with its heading, such as `[limits]`, `[[box]]` or `[joints.NAME]`."""
    for option in alternatives(info):
        if isinstance(option, inspect.StructType):
            kind = f" with `{option.tag_field} = {format_value(option.tag)}`" if option.tag_field else ""
            yield f"`[{path}]`{kind}", option.cls
        elif isinstance(option, inspect.ListType | inspect.DictType):
            (*_, entry_type) = item_types(option)
            for entry in alternatives(entry_type):
                if isinstance(entry, inspect.StructType):
                    is_list = isinstance(option, inspect.ListType)
                    yield (f"`[[{path}]]`" if is_list else f"`[{path}.NAME]`"), entry.cls


def _first_paragraph(struct: type[msgspec.Struct]) -> str:
    """Return the beginning of a Struct's docstring."""
    return " ".join(cleandoc(struct.__doc__ or "").partition("\n\n")[0].split())


def _table(struct: type[msgspec.Struct]) -> list[str]:
    """Return the table of a Struct's keys."""
    docs = document_fields(struct)
    note: list[str] = []
    if issubclass(struct, FileStruct) and struct.exceptions_to:
        sections = ", ".join(f"`[{section.__name__.lower()}]`" for section in struct.exceptions_to)
        note = ["", EXCEPTIONS.format(sections=sections)]
        of_sections = {name for section in struct.exceptions_to for name in section.__struct_fields__}
        docs = [doc for doc in docs if doc.name not in of_sections]
    if not docs:
        return ["It has no keys."]
    rows = ["| key | type | unit | default | range | description |", "|---|---|---|---|---|---|"]
    return [*rows, *(_row(doc) for doc in docs), *note]


def _row(doc: FieldDoc) -> str:
    cells = [f"`{doc.name}`", doc.type_words, doc.unit, _default(doc), doc.range_words, doc.description]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(doc: FieldDoc) -> str:
    if doc.default is None:
        return "*required*"
    if doc.default in ("none", "its defaults"):
        return f"*{doc.default}*"
    return f"`{doc.default}`"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")

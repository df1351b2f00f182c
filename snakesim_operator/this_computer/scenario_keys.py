"""Lists every key of a scenario with its documentation, its value, and the file or flag that the value comes from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
from msgspec import inspect

from snakesim_hal.model.fields.field_docs import FieldDoc, document_fields
from snakesim_hal.model.fields.field_types import list_union_members
from snakesim_hal.model.fields.field_words import list_item_types
from snakesim_hal.model.files import iterate_leaves
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    PHYSICS_MODELS,
    list_installed_plugins,
    load_plugin_unless_file,
)
from snakesim_hal.model.scenario import LoadedScenario, RunConfig
from snakesim_operator.this_computer.plugin_sections import decode_section, get_section_type

PLUGIN_SECTIONS = {"controllers": CONTROLLERS, "backends": BACKENDS}
JOINTS_KEY = "robot.joints"  # a table by name, which may have an entry for every joint of the robot
# A key that names a plugin, whose settings are in the section of the next name.
PHYSICS_MODEL = "physics_model"
PHYSICS_MODEL_SETTINGS = "physics_model_settings"
UNCHECKED_DESCRIPTION = "Checked by the code of its plugin."
UNCHECKED_FIELD_DOC = FieldDoc(
    "", "any value", "", "", "none", UNCHECKED_DESCRIPTION, inspect.AnyType()
)


@dataclass(frozen=True)
class ScenarioKey:
    """A key of a scenario: its documentation, its value, and the file or flag that gives the value."""

    name: str  # dotted
    doc: FieldDoc
    value: Any
    origin: str = "default"
    # True: it stands for this key in every entry of a list or of a table by name.
    is_pattern: bool = False

    @property
    def is_table(self) -> bool:
        """Return whether other keys are inside of this one."""
        return "table" in self.doc.type_words


def collect_keys(scenario: LoadedScenario, include_section_of: str = "") -> dict[str, ScenarioKey]:
    """Collect every key of a scenario by its dotted name, with documentation, value and origin.

    Args:
        scenario: The checked scenario, with the origin of each value.
        include_section_of: Dotted name of a key, or an empty text. If the key is in the section of a plugin that the
            scenario does not use, the keys of that section are collected, too.

    Returns:
        The keys by dotted name.
    """
    config = scenario.config
    values = msgspec.to_builtins(config)
    # The robot file names only joints that differ from the others. Here every joint gets an entry, so that the keys of
    # each joint are collected; the value of the table itself is set back to that of the file below.
    joints_in_file = values["robot"]["joints"]
    values["robot"]["joints"] = {
        joint.name: joints_in_file.get(joint.name, {}) for joint in config.robot.joint_table
    }

    key_by_name: dict[str, ScenarioKey] = {}
    for key in _iter_struct_keys(RunConfig, values, ""):
        # Several kinds of one table, such as obstacles of several shapes, share a key.
        if key.name in key_by_name:
            key_by_name[key.name] = _merge_duplicate_keys(key_by_name[key.name], key)
        else:
            key_by_name[key.name] = key
    key_by_name[JOINTS_KEY] = replace(key_by_name[JOINTS_KEY], value=joints_in_file)
    for section, group in PLUGIN_SECTIONS.items():
        for key in _iter_plugin_keys(scenario, section, group, include_section_of):
            key_by_name[key.name] = key
    return {
        name: replace(key, origin=scenario.table.find_origin(name))
        for name, key in key_by_name.items()
    }


def _merge_duplicate_keys(key: ScenarioKey, other: ScenarioKey) -> ScenarioKey:
    """Merge the documentation of a key that several kinds of one table have, such as the key `kind` itself.

    The merged key allows the values of each of them. A key with a default has the same meaning in every kind.
    """
    if key.doc.range_words == other.doc.range_words or key.doc.default is not None:
        return key
    range_words = f"{key.doc.range_words}, {other.doc.range_words}"
    return replace(key, doc=replace(key.doc, range_words=range_words))


def _iter_struct_keys(
    struct: type[msgspec.Struct], values: Any, prefix: str, *, is_pattern: bool = False
) -> Iterator[ScenarioKey]:
    """Yield the keys of a Struct, each before the keys inside of it.

    Args:
        struct: Type of the table.
        values: The table; anything but a dict if it is missing.
        prefix: Prefix of the dotted names, with its last dot.
        is_pattern: Whether the keys stand for those of every entry of a list or a table by name.
    """
    for doc in document_fields(struct):
        name = f"{prefix}{doc.name}"
        value = values.get(doc.name) if isinstance(values, dict) else None
        yield ScenarioKey(name, doc, value, is_pattern=is_pattern)
        if doc.name == PHYSICS_MODEL_SETTINGS and isinstance(values, dict):
            yield from _iter_physics_model_keys(str(values.get(PHYSICS_MODEL)), value, name)
        else:
            yield from _iter_inner_keys(doc.type_info, value, name, is_pattern=is_pattern)


def _iter_physics_model_keys(model: str, values: Any, name: str) -> Iterator[ScenarioKey]:
    plugin = load_plugin_unless_file(PHYSICS_MODELS, model)
    if plugin is None:
        yield from _iter_unchecked_keys(values, name)
        return
    checked = decode_section(plugin, values, "the scenario", name)
    yield from _iter_struct_keys(get_section_type(plugin), msgspec.to_builtins(checked), f"{name}.")


def _iter_inner_keys(
    info: inspect.Type, value: Any, name: str, *, is_pattern: bool = False
) -> Iterator[ScenarioKey]:
    """Yield the keys inside of a value: of a table, of entries of a list, or of entries of a table by name."""
    for option in list_union_members(info):
        match option:
            case inspect.StructType() if _matches_tag(option, value):
                yield from _iter_struct_keys(option.cls, value, f"{name}.", is_pattern=is_pattern)
            case inspect.ListType() | inspect.DictType() if _holds_tables(option):
                (*_, entry_type) = list_item_types(option)
                yield from _iter_entry_keys(entry_type, value, name)
            case inspect.DictType(value_type=inspect.AnyType()) if isinstance(value, dict):
                yield from _iter_unchecked_keys(value, name)
            case _:
                pass


def _iter_entry_keys(entry_type: inspect.Type, value: Any, name: str) -> Iterator[ScenarioKey]:
    """Yield the keys of every entry, and then a pattern for an entry."""
    entries = value.items() if isinstance(value, dict) else enumerate(value or [])
    for entry_name, entry in entries:
        entry_key = f"{name}.{entry_name}"
        yield ScenarioKey(entry_key, _document_entry(entry_type, entry_name), entry)
        yield from _iter_inner_keys(entry_type, entry, entry_key)
    yield from _iter_inner_keys(entry_type, None, name, is_pattern=True)


def _document_entry(entry_type: inspect.Type, entry_name: Any) -> FieldDoc:
    """Return the documentation of an entry: the first line of its Struct's docstring."""
    structs = [
        option.cls
        for option in list_union_members(entry_type)
        if isinstance(option, inspect.StructType)
    ]
    meanings = [(struct.__doc__ or "").partition("\n")[0] for struct in structs]
    return FieldDoc(str(entry_name), "table", "", "", None, " / ".join(meanings), entry_type)


def _iter_unchecked_keys(value: Mapping[str, Any], name: str) -> Iterator[ScenarioKey]:
    """Yield the keys of a section whose type only a plugin's code knows."""
    for inner_name, inner in iterate_leaves(value, name):
        if inner_name != name:
            yield ScenarioKey(inner_name, UNCHECKED_FIELD_DOC, inner)


def _matches_tag(struct: inspect.StructType, value: Any) -> bool:
    """Return whether a table may be a Struct; true for a table that is missing."""
    if struct.tag_field is None or not isinstance(value, dict):
        return True
    return value.get(struct.tag_field) == struct.tag


def _holds_tables(option: inspect.Type) -> bool:
    return any(
        isinstance(inner, inspect.StructType)
        for entry in list_item_types(option)
        for inner in list_union_members(entry)
    )


def _iter_plugin_keys(
    scenario: LoadedScenario, section: str, group: str, include_section_of: str
) -> Iterator[ScenarioKey]:
    """Yield the keys of controllers or backends: of the chosen one, and of those that have values in the scenario.

    Args:
        scenario: The checked scenario.
        section: "controllers" or "backends".
        group: Entry-point group of the installed plugins of this kind.
        include_section_of: Dotted name of a key whose plugin is included even if the scenario does not use it; may be
            empty.
    """
    config = scenario.config
    if section == "controllers":
        values_by_name: Mapping[str, dict[str, Any]] = config.controllers
        chosen_plugin = config.controller
    else:
        values_by_name = config.backends
        chosen_plugin = config.backend
    installed_names = list_installed_plugins(group)
    plugin_by_section: dict[str, str] = {}  # name or path of the plugin, by name of its section
    for name in [*values_by_name, *_find_plugin_name_in_key(include_section_of, section)]:
        if name in installed_names:
            plugin_by_section[name] = name
    plugin_by_section[chosen_plugin.rpartition(":")[2]] = chosen_plugin
    for name in sorted({*plugin_by_section, *values_by_name}):
        key = f"{section}.{name}"
        values = values_by_name.get(name, {})
        plugin = (
            load_plugin_unless_file(group, plugin_by_section[name])
            if name in plugin_by_section
            else None
        )
        if plugin is None:
            yield ScenarioKey(
                key, replace(UNCHECKED_FIELD_DOC, name=name, type_words="table"), values
            )
            yield from _iter_unchecked_keys(values, key)
            continue
        description = (get_section_type(plugin).__doc__ or "").partition("\n")[0]
        yield ScenarioKey(
            key,
            replace(UNCHECKED_FIELD_DOC, name=name, type_words="table", description=description),
            values,
        )
        yield from _iter_plugin_setting_keys(scenario, plugin, values, key)


def _find_plugin_name_in_key(key_name: str, section: str) -> list[str]:
    """Return a list with the plugin's name in a key such as `controllers.hold.KEY`.

    The list is empty for a key in another section.
    """
    first, _, rest = key_name.partition(".")
    return [rest.partition(".")[0]] if first == section else []


def _iter_plugin_setting_keys(
    scenario: LoadedScenario, plugin: Any, values: dict[str, Any], section: str
) -> Iterator[ScenarioKey]:
    required_names = [
        doc.name for doc in document_fields(get_section_type(plugin)) if doc.default is None
    ]
    if all(name in values for name in required_names):
        checked = decode_section(
            plugin, values, scenario.table.source, section, scenario.table.origin_by_key
        )
        yield from _iter_struct_keys(
            get_section_type(plugin), msgspec.to_builtins(checked), f"{section}."
        )
    else:  # of a plugin that the scenario does not use
        yield from _iter_struct_keys(get_section_type(plugin), values, f"{section}.")

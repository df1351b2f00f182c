"""Lists every key of a scenario with its documentation, its value, and the file or flag that the value comes from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
from msgspec import inspect

from snakesim_hal.model.field_docs import FieldDoc, document_fields
from snakesim_hal.model.field_types import alternatives
from snakesim_hal.model.field_words import item_types
from snakesim_hal.model.files import leaves
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    PHYSICS_MODELS,
    find_installed,
    list_installed,
)
from snakesim_hal.model.scenario import Loaded, RunConfig
from snakesim_operator.this_computer.plugin_sections import decode_section, section_type

PLUGIN_SECTIONS = {"controllers": CONTROLLERS, "backends": BACKENDS}
JOINTS = "robot.joints"  # a table by name, which may have an entry for every joint of the robot
PHYSICS_MODEL = "physics_model"  # a key that names a plugin, whose settings are in the section of the next name
PHYSICS_MODEL_SETTINGS = "physics_model_settings"
NOT_CHECKED = "Checked by the code of its plugin."
ANY_VALUE = FieldDoc("", "any value", "", "", "none", NOT_CHECKED, inspect.AnyType())


@dataclass(frozen=True)
class Key:
    """A key of a scenario: its documentation, its value, and the file or flag that gives the value."""

    name: str  # dotted
    doc: FieldDoc
    value: Any
    origin: str = "default"
    is_pattern: bool = False  # true: it stands for this key in every entry of a list or of a table by name

    @property
    def is_table(self) -> bool:
        """Return whether other keys are inside of this one."""
        return "table" in self.doc.type_words


def list_keys(loaded: Loaded, named: str = "") -> dict[str, Key]:
    """Return every key of a scenario by its dotted name.

    Args:
        loaded: The checked scenario, with the origin of each value.
        named: A key; if it is in the section of a plugin that the scenario does not use, that section is listed too.
    """
    config = loaded.config
    values = msgspec.to_builtins(config)
    # The file names only joints that differ from the others. The list shows every joint.
    joints_in_file = values["robot"]["joints"]
    values["robot"]["joints"] = {joint.name: joints_in_file.get(joint.name, {}) for joint in config.robot.joint_table}

    keys: dict[str, Key] = {}
    for key in _keys_of_struct(RunConfig, values, ""):
        if key.name in keys:
            keys[key.name] = _merge_kinds(keys[key.name], key)
        else:
            keys[key.name] = key
    keys[JOINTS] = replace(keys[JOINTS], value=joints_in_file)
    for section, group in PLUGIN_SECTIONS.items():
        for key in _keys_of_plugins(loaded, section, group, named):
            keys[key.name] = key
    return {name: replace(key, origin=loaded.table.origin_of(name)) for name, key in keys.items()}


def _merge_kinds(key: Key, other: Key) -> Key:
    """Return a key that tables of several kinds have; a `kind` itself may be that of each of them."""
    if key.doc.range_words == other.doc.range_words or key.doc.default is not None:
        return key
    range_words = f"{key.doc.range_words}, {other.doc.range_words}"
    return replace(key, doc=replace(key.doc, range_words=range_words))


def _keys_of_struct(
    struct: type[msgspec.Struct], values: Any, prefix: str, *, is_pattern: bool = False
) -> Iterator[Key]:
    """Yield the keys of a Struct, and those inside of them."""
    for doc in document_fields(struct):
        name = f"{prefix}{doc.name}"
        value = values.get(doc.name) if isinstance(values, dict) else None
        yield Key(name, doc, value, is_pattern=is_pattern)
        if doc.name == PHYSICS_MODEL_SETTINGS and isinstance(values, dict):
            yield from _keys_of_physics_model(str(values.get(PHYSICS_MODEL)), value, name)
        else:
            yield from _keys_inside(doc.type_info, value, name, is_pattern=is_pattern)


def _keys_of_physics_model(model: str, values: Any, name: str) -> Iterator[Key]:
    plugin = find_installed(PHYSICS_MODELS, model)
    if plugin is None:
        yield from _keys_not_checked(values, name)
        return
    checked = decode_section(plugin, values, "the scenario", name)
    yield from _keys_of_struct(section_type(plugin), msgspec.to_builtins(checked), f"{name}.")


def _keys_inside(info: inspect.Type, value: Any, name: str, *, is_pattern: bool = False) -> Iterator[Key]:
    """Yield the keys inside of a value: of a table, of entries of a list, or of entries of a table by name."""
    for option in alternatives(info):
        match option:
            case inspect.StructType() if _tag_matches(option, value):
                yield from _keys_of_struct(option.cls, value, f"{name}.", is_pattern=is_pattern)
            case inspect.ListType() | inspect.DictType() if _holds_tables(option):
                (*_, entry_type) = item_types(option)
                yield from _keys_of_entries(entry_type, value, name)
            case inspect.DictType(value_type=inspect.AnyType()) if isinstance(value, dict):
                yield from _keys_not_checked(value, name)
            case _:
                pass


def _keys_of_entries(entry_type: inspect.Type, value: Any, name: str) -> Iterator[Key]:
    """Yield the keys of every entry, and then a pattern for an entry."""
    entries = value.items() if isinstance(value, dict) else enumerate(value or [])
    for entry_name, entry in entries:
        entry_key = f"{name}.{entry_name}"
        yield Key(entry_key, _document_entry(entry_type, entry_name), entry)
        yield from _keys_inside(entry_type, entry, entry_key)
    yield from _keys_inside(entry_type, None, name, is_pattern=True)


def _document_entry(entry_type: inspect.Type, entry_name: Any) -> FieldDoc:
    """Return the documentation of an entry: the first line of its Struct's docstring."""
    structs = [option.cls for option in alternatives(entry_type) if isinstance(option, inspect.StructType)]
    meanings = [(struct.__doc__ or "").partition("\n")[0] for struct in structs]
    return FieldDoc(str(entry_name), "table", "", "", None, " / ".join(meanings), entry_type)


def _keys_not_checked(value: Mapping[str, Any], name: str) -> Iterator[Key]:
    """Yield the keys of a section whose type only a plugin's code knows."""
    for inner_name, inner in leaves(value, name):
        if inner_name != name:
            yield Key(inner_name, ANY_VALUE, inner)


def _tag_matches(struct: inspect.StructType, value: Any) -> bool:
    """Return whether a table may be a Struct; true for a table that is missing."""
    if struct.tag_field is None or not isinstance(value, dict):
        return True
    return value.get(struct.tag_field) == struct.tag


def _holds_tables(option: inspect.Type) -> bool:
    return any(isinstance(inner, inspect.StructType) for entry in item_types(option) for inner in alternatives(entry))


def _keys_of_plugins(loaded: Loaded, section: str, group: str, named: str) -> Iterator[Key]:
    """Yield the keys of controllers or backends: of the chosen one, of those with values, and of the named one.

    Args:
        loaded: The checked scenario.
        section: "controllers" or "backends".
        group: The entry-point group at which installed plugins of this kind register.
        named: A key whose plugin is listed even if the scenario does not use it; may be empty.
    """
    config = loaded.config
    if section == "controllers":
        values_by_name: Mapping[str, dict[str, Any]] = config.controllers
        chosen = config.controller
    else:
        values_by_name = config.backends
        chosen = config.backend
    installed_names = list_installed(group)
    plugins: dict[str, str] = {}  # name of the section -> name or path of the plugin
    for name in [*values_by_name, *_name_in(named, section)]:
        if name in installed_names:
            plugins[name] = name
    plugins[chosen.rpartition(":")[2]] = chosen
    for name in sorted({*plugins, *values_by_name}):
        key = f"{section}.{name}"
        values = values_by_name.get(name, {})
        plugin = find_installed(group, plugins[name]) if name in plugins else None
        if plugin is None:
            yield Key(key, replace(ANY_VALUE, name=name, type_words="table"), values)
            yield from _keys_not_checked(values, key)
            continue
        description = (section_type(plugin).__doc__ or "").partition("\n")[0]
        yield Key(key, replace(ANY_VALUE, name=name, type_words="table", description=description), values)
        yield from _keys_of_settings(loaded, plugin, values, key)


def _name_in(named: str, section: str) -> list[str]:
    """Return the plugin's name in a key such as `controllers.hold.KEY`; none for a key in another section."""
    first, _, rest = named.partition(".")
    return [rest.partition(".")[0]] if first == section else []


def _keys_of_settings(loaded: Loaded, plugin: Any, sections: dict[str, Any], section: str) -> Iterator[Key]:
    required = [doc.name for doc in document_fields(section_type(plugin)) if doc.default is None]
    if all(name in sections for name in required):
        checked = decode_section(plugin, sections, loaded.table.source, section, loaded.table.origin)
        yield from _keys_of_struct(section_type(plugin), msgspec.to_builtins(checked), f"{section}.")
    else:  # of a plugin that the scenario does not use
        yield from _keys_of_struct(section_type(plugin), sections, f"{section}.")

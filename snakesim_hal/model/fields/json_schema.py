"""The JSON Schema of a Struct, with the description, the default and the unit of every field."""

import re
from inspect import cleandoc
from typing import Any

import msgspec
from msgspec import inspect

from snakesim_hal.model.fields.field_docs import collect_field_descriptions, inspect_struct_type
from snakesim_hal.model.fields.field_types import list_union_members
from snakesim_hal.model.fields.field_words import (
    find_unit,
    find_unit_in_type,
    get_default,
    list_item_types,
)


def make_schema(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON Schema of a Struct, with the description, default and unit of every field."""
    schema = msgspec.json.schema(struct)
    definitions: dict[str, Any] = schema.get("$defs", {})
    for definition in definitions.values():
        # Without its indentation, as Python itself removes it from 3.13 on.
        if "description" in definition:
            definition["description"] = cleandoc(definition["description"])
    for part in list_structs(struct):
        full_name = re.sub(r"[^a-zA-Z0-9.\-_]", "_", f"{part.__module__}.{part.__qualname__}")
        # Msgspec uses full names if two are equal.
        name = full_name if full_name in definitions else part.__name__
        _complete_definition(definitions[name], part)
    return schema


def _complete_definition(definition: dict[str, Any], struct: type[msgspec.Struct]) -> None:
    """Add descriptions, defaults and units to the properties of one Struct."""
    descriptions = collect_field_descriptions(struct)
    for field in inspect_struct_type(struct).fields:
        name = field.encode_name
        added = definition["properties"][name]
        if name in descriptions:
            added["description"] = descriptions[name]
        if not field.required and "default" not in added:
            added["default"] = get_default(field)
        unit = find_unit(name, field.type)
        if unit and not find_unit_in_type(field.type):
            added["unit"] = unit


def list_structs(struct: type[msgspec.Struct]) -> list[type[msgspec.Struct]]:
    """Return a Struct and all Structs inside of it, each once."""
    found: dict[type[msgspec.Struct], None] = {}
    waiting: list[inspect.Type] = [inspect_struct_type(struct)]
    while waiting:
        option = waiting.pop()
        if isinstance(option, inspect.StructType):
            if option.cls in found:
                continue
            found[option.cls] = None
            waiting += [
                alternative
                for field in option.fields
                for alternative in list_union_members(field.type)
            ]
        for inner in list_item_types(option):
            waiting += list_union_members(inner)
    return list(found)

"""Describe types, ranges, units and defaults of fields in words, for tables and `snakesim config --explain`."""

import json
from typing import Any

import msgspec
from msgspec import inspect

from snakesim_hal.model.fields.field_types import find_declared_unit, list_union_members

# Units by the end of a field's name, for numbers whose type has no unit; a longer end comes before a shorter one.
UNITS_BY_SUFFIX = {
    "_nm_s_per_rad": "N·m·s/rad",
    "_nm_per_rad": "N·m/rad",
    "_rad_s2": "rad/s²",
    "_kg_m2": "kg·m²",
    "_rad_s": "rad/s",
    "_m_s2": "m/s²",
    "_nm_s": "N·m/s",
    "_m_s": "m/s",
    "_per_m2": "1/m²",
    "_rad": "rad",
    "_nm": "N·m",
    "_hz": "Hz",
    "_kg": "kg",
    "_ns": "ns",
    "_s": "s",
    "_m": "m",
    "_n": "N",
    "_c": "°C",
    "_v": "V",
    "_a": "A",
}
UNIT_WORDS = {"per", "turns", *(word for suffix in UNITS_BY_SUFFIX for word in suffix.split("_"))}


def describe_type(info: inspect.Type) -> str:
    """Return the type of a value in a few words. Whether a field may be left out is not part of it."""
    words: list[str] = []
    for option in list_union_members(info):
        name = _get_type_name(option)
        if name and name not in words:
            words.append(name)
    return " or ".join(words) or "any value"


def _get_type_name(option: inspect.Type) -> str:
    """Return the name of a type that is not a union. It is empty for None, which no TOML file contains."""
    match option:
        case inspect.NoneType():
            return ""
        case inspect.FloatType():
            return "number"
        case inspect.IntType():
            return "whole number"
        case inspect.BoolType():
            return "boolean"
        case inspect.LiteralType(values=values):
            return "whole number" if isinstance(values[0], int) else "text"
        case inspect.StrType() | inspect.EnumType():
            return "text"
        case inspect.StructType():
            return "table"
        case _:
            return _get_container_type_name(option)


def _get_container_type_name(option: inspect.Type) -> str:
    """Return the name of a type that holds other values."""
    match option:
        case inspect.DictType(value_type=inspect.AnyType()):
            return "table"
        case inspect.DictType(value_type=value_type):
            return f"{_pluralize(describe_type(value_type))} by name"
        case inspect.ListType(item_type=inspect.AnyType()):
            return "list"
        case inspect.ListType(item_type=item_type):
            return f"list of {_pluralize(describe_type(item_type))}"
        case inspect.TupleType():
            return f"{len(option.item_types)} {_pluralize(describe_type(option.item_types[0]))}"
        case _:
            return "any value"


def _pluralize(words: str) -> str:
    if words[0].isdigit():  # such as `2 numbers`
        return f"[{words}]"
    return " or ".join(f"{word}s" for word in words.split(" or "))


def describe_range(info: inspect.Type) -> str:
    """Return what a value is limited to beyond its type; empty if all values are allowed."""
    limits: list[str] = []
    for option in list_union_members(info):
        limit = _describe_limits(option)
        if limit and limit not in limits:
            limits.append(limit)
    return " or ".join(limits)


def _describe_limits(option: inspect.Type) -> str:
    """Describe the allowed values of a type in words, such as ">= 0, < 1". Empty for a type without limits."""
    match option:
        case inspect.FloatType() | inspect.IntType():
            bounds = ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
            return ", ".join(
                f"{sign} {_format_number(bound)}" for sign, bound in bounds if bound is not None
            )
        case inspect.LiteralType(values=values):
            return ", ".join(format_value(value) for value in values)
        case inspect.EnumType(cls=enum):
            return ", ".join(format_value(member.value) for member in enum)
        case inspect.StructType(tag_field=str()):
            return f"{option.tag_field} = {format_value(option.tag)}"
        case inspect.StrType():
            return _describe_length(option.min_length, option.max_length, "characters")
        case inspect.ListType():
            return _join_limits(
                _describe_length(option.min_length, option.max_length, "entries"), option.item_type
            )
        case inspect.DictType() if not isinstance(option.value_type, inspect.AnyType):
            return _join_limits("", option.value_type)
        case inspect.TupleType():
            return _join_limits("", option.item_types[0])
        case _:
            return ""


def _join_limits(limits: str, item_type: inspect.Type) -> str:
    """Return the limits of a container, followed by those of its items."""
    item_limits = describe_range(item_type)
    return ", each ".join(part for part in (limits, item_limits) if part)


def _describe_length(minimum: int | None, maximum: int | None, noun: str) -> str:
    if maximum is None:
        return "not empty" if minimum else ""
    if minimum:
        return f"{minimum} to {maximum} {noun}"
    return f"at most {maximum} {noun}"


def _format_number(number: float) -> str:
    return f"{number:.10g}"


def find_unit(name: str, info: inspect.Type) -> str:
    """Return the unit of a field's number or numbers, from its type or else from its name; empty if there is none."""
    unit = find_unit_in_type(info)
    if unit == "1":
        return ""
    if unit or not _contains_numbers(info):
        return unit
    return find_unit_in_name(name)


def find_unit_in_name(name: str) -> str:
    """Return the unit that a name ends with; empty if the end is only a part of a unit that is not in the table."""
    for suffix, unit in UNITS_BY_SUFFIX.items():
        if name.endswith(suffix):
            word_before = name.removesuffix(suffix).rpartition("_")[2]
            return "" if word_before in UNIT_WORDS else unit
    return ""


def find_unit_in_type(info: inspect.Type) -> str:
    """Return the first unit in a type, also inside of unions, lists and tuples."""
    unit = find_declared_unit(info)
    if unit:
        return unit
    if isinstance(info, inspect.Metadata):
        return find_unit_in_type(info.type)
    inner_types = info.types if isinstance(info, inspect.UnionType) else list_item_types(info)
    for inner in inner_types:
        unit = find_unit_in_type(inner)
        if unit:
            return unit
    return ""


def _contains_numbers(info: inspect.Type) -> bool:
    """Return whether values of a type are numbers or contain numbers."""
    for option in list_union_members(info):
        if isinstance(option, inspect.FloatType | inspect.IntType):
            return True
        if any(_contains_numbers(inner) for inner in list_item_types(option)):
            return True
    return False


def list_item_types(option: inspect.Type) -> tuple[inspect.Type, ...]:
    """Return the types of the entries of a list, a tuple or a table by name; of any other type, none."""
    match option:
        case inspect.ListType(item_type=item_type):
            return (item_type,)
        case inspect.TupleType():
            return option.item_types
        case inspect.DictType(value_type=value_type):
            return (value_type,)
        case _:
            return ()


def describe_default(field: inspect.Field) -> str:
    """Return the default of a field that is not required, in words for a table."""
    if isinstance(field.default, msgspec.Struct):
        return "its defaults"
    return format_value(get_default(field))


def get_default(field: inspect.Field) -> Any:
    """Return the default of a field that is not required, as built-in types."""
    has_factory = field.default_factory is not msgspec.NODEFAULT
    return msgspec.to_builtins(field.default_factory() if has_factory else field.default)


def format_value(value: Any) -> str:
    """Return a value as a TOML file has it; a missing value is `none`."""
    match value:
        case None:
            return "none"
        case float():
            return repr(value)
        case list() | tuple():
            return "[" + ", ".join(format_value(entry) for entry in value) + "]"
        case dict():
            return (
                "{"
                + ", ".join(f"{key} = {format_value(entry)}" for key, entry in value.items())
                + "}"
            )
        case _:
            return json.dumps(value, ensure_ascii=False)

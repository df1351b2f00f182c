"""The type that a Struct expects at a place of a file, in words: for the errors of `snakesim_hal.model.files`."""

from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import inspect


def type_at(struct: type[msgspec.Struct], steps: list[str], values: Any) -> inspect.Type | None:
    """The declared type at a path inside a Struct, as msgspec describes it; `values` select among several Structs."""
    info: inspect.Type | None = inspect.type_info(struct)
    for step in steps:
        info = next((found for option in _options_for(info, values) if (found := _inside(option, step, info))), None)
        values = value_at(values, [step])
    return info


def fields_at(struct: type[msgspec.Struct], steps: list[str], values: Any) -> dict[str, inspect.Type]:
    """All fields of the Struct at a path, including its tag."""
    info = type_at(struct, steps, values)
    fields: dict[str, inspect.Type] = {}
    for option in _options_for(info, value_at(values, steps)):
        if isinstance(option, inspect.StructType):
            fields |= {field.encode_name: field.type for field in option.fields}
            if option.tag_field is not None:
                fields[option.tag_field] = _tags(info)
    return fields


def value_at(values: Any, steps: list[str]) -> Any:
    """The value at a path; None where there is none."""
    for step in steps:
        if isinstance(values, dict):
            values = values.get(step)
        elif isinstance(values, list) and step.isdecimal() and int(step) < len(values):
            values = values[int(step)]
        else:
            return None
    return values


def options(info: inspect.Type | None) -> list[inspect.Type]:
    """The alternatives of a union; one for any other type."""
    if info is None:
        return []
    if isinstance(info, inspect.Metadata):
        return options(info.type)
    if isinstance(info, inspect.UnionType):
        return [leaf for option in info.types for leaf in options(option)]
    return [info]


def unit_of(info: inspect.Type | None) -> str:
    """The unit of a number; empty when it has none."""
    if isinstance(info, inspect.Metadata):
        return str((info.extra_json_schema or {}).get("unit", ""))
    return ""


def in_words(info: inspect.Type | None) -> str:
    """The type of a field, in words."""
    said: list[str] = []
    for option in options(info):
        word = _word(option, unit_of(info))
        if word is not None:
            said.append(word)
    return " or ".join(said) or "another value"


def _options_for(info: inspect.Type | None, value: Any) -> Sequence[inspect.Type]:
    """Of a union of tagged Structs the one whose tag the value has, if it has one of them."""
    every = options(info)
    tagged = [o for o in every if isinstance(o, inspect.StructType) and _has_tag(value, o)]
    return tagged or every


def _has_tag(value: Any, option: inspect.StructType) -> bool:
    return isinstance(value, dict) and option.tag_field is not None and value.get(option.tag_field) == option.tag


def _tags(info: inspect.Type | None) -> inspect.Type:
    tags = [option.tag for option in options(info) if isinstance(option, inspect.StructType)]
    return inspect.LiteralType(tuple(tag for tag in tags if tag is not None))


def _inside(option: inspect.Type, step: str, union: inspect.Type | None) -> inspect.Type | None:
    if isinstance(option, inspect.StructType):
        if step == option.tag_field:
            return _tags(union)
        return next((field.type for field in option.fields if field.encode_name == step), None)
    if isinstance(option, inspect.ListType):
        return option.item_type
    if isinstance(option, inspect.TupleType) and step.isdecimal():
        return option.item_types[int(step)] if int(step) < len(option.item_types) else None
    return option.value_type if isinstance(option, inspect.DictType) else None


def _word(option: inspect.Type, unit: str) -> str | None:
    match option:
        case inspect.FloatType() | inspect.IntType():
            return _number(option, unit)
        case inspect.LiteralType(values=values):
            return "one of " + ", ".join(repr(value) for value in values)
        case inspect.EnumType(cls=enum):
            return "one of " + ", ".join(repr(member.value) for member in enum)
        case inspect.StrType():
            return "a text"
        case inspect.BoolType():
            return "true or false"
        case inspect.StructType(fields=fields, tag_field=None):
            return "a section with " + ", ".join(field.encode_name for field in fields)
        case inspect.StructType(fields=fields):
            told = [f"{option.tag_field} = {option.tag!r}", *(field.encode_name for field in fields)]
            return "a section with " + ", ".join(told)
        case inspect.ListType():
            return f"a list, each {in_words(option.item_type)}"
        case inspect.TupleType():
            return f"{len(option.item_types)} values, each {in_words(option.item_types[0])}"
        case inspect.DictType():
            return "a section"
        case _:
            return None


def _number(option: inspect.FloatType | inspect.IntType, unit: str) -> str:
    word = "a number" if isinstance(option, inspect.FloatType) else "a whole number"
    signs = ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
    bounds = [f"{sign} {bound:g}" for sign, bound in signs if bound is not None]
    return " ".join(filter(None, [word, " and ".join(bounds), f"in {unit}" if unit else ""]))

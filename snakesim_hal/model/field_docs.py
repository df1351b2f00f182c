"""Describe the fields of a Struct for users: type, unit, range, default and meaning, and the JSON Schema with all of it.

The meaning of a field is the string literal on the line after it. Python discards such a literal, so it costs nothing at
run time. Only the functions here read it, from the source file of the Struct's class. A field without such a literal has
the description of its type, if the type has one (`snakesim_hal.wire.quantities.about`).
"""

import ast
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from inspect import cleandoc
from pathlib import Path
from typing import Any

import msgspec
from msgspec import inspect

from snakesim_hal.model.field_types import alternatives, unit_of
from snakesim_hal.model.files import FileStruct

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


@dataclass(frozen=True)
class FieldDoc:
    """What a user may want to know about one field."""

    name: str
    type_words: str  # such as `number`, `list of texts` or `table`
    unit: str  # empty: it has none
    range_words: str  # bounds, choices or lengths; empty: every value of the type is allowed
    default: str | None  # as in a TOML file; None: the field is required
    description: str
    type_info: inspect.Type


def document_fields(struct: type[msgspec.Struct]) -> list[FieldDoc]:
    """Return the documentation of all fields of a Struct in their order; the tag of a Struct comes first."""
    info = _type_info(struct)
    descriptions = describe_fields(struct)
    docs = [_document_field(field, descriptions.get(field.encode_name, "")) for field in info.fields]
    if info.tag_field is None:
        return docs
    return [_document_tag(info), *docs]


@cache
def _type_info(struct: type[msgspec.Struct]) -> inspect.StructType:
    info = inspect.type_info(struct)
    assert isinstance(info, inspect.StructType)
    return info


def _document_tag(info: inspect.StructType) -> FieldDoc:
    return FieldDoc(
        name=str(info.tag_field),
        type_words="text",
        unit="",
        range_words=format_value(info.tag),
        default=None,
        description="Kind of this table, which decides what its other keys are.",
        type_info=inspect.LiteralType((info.tag,)),
    )


def _document_field(field: inspect.Field, description: str) -> FieldDoc:
    return FieldDoc(
        name=field.encode_name,
        type_words=describe_type(field.type),
        unit=find_unit(field.encode_name, field.type),
        range_words=describe_range(field.type),
        default=None if field.required else _describe_default(field),
        description=description,
        type_info=field.type,
    )


# --- descriptions ----------------------------------------------------------------------------------------------


@cache
def describe_fields(struct: type[msgspec.Struct]) -> dict[str, str]:
    """Return the descriptions of a Struct's fields by name, those of inherited fields included.

    A field without a description is missing, and so are all fields of a class whose source file cannot be read.
    """
    descriptions: dict[str, str] = {}
    for field in _type_info(struct).fields:
        description = _description_of_type(field.type)
        if description:
            descriptions[field.encode_name] = description
    if issubclass(struct, FileStruct):
        for section in struct.exceptions_to:
            descriptions |= _describe_exceptions(section)
    for base in reversed(struct.__mro__):
        if issubclass(base, msgspec.Struct) and base is not msgspec.Struct:
            descriptions |= _read_docstrings(base)
    names = [field.encode_name for field in _type_info(struct).fields]
    return {name: descriptions[name] for name in names if name in descriptions}


def _describe_exceptions(section: type[msgspec.Struct]) -> dict[str, str]:
    """Return the descriptions of a section for all, as they are for an exception to it, where None has another meaning."""
    descriptions: dict[str, str] = {}
    for name, description in describe_fields(section).items():
        meaning, _, _ = description.partition("; none:")
        descriptions[name] = f"{meaning.removesuffix('.')}; none: as in the section for all."
    return descriptions


def _description_of_type(info: inspect.Type) -> str:
    if not isinstance(info, inspect.Metadata):
        return ""
    extra = info.extra_json_schema or {}
    return str(extra.get("description", ""))


def _read_docstrings(struct: type) -> dict[str, str]:
    """Return the string literals after the fields in the body of a class, each as one line, by the field's name."""
    definition = _find_class(struct)
    if definition is None:
        return {}
    docstrings: dict[str, str] = {}
    for statement, following in zip(definition.body, definition.body[1:], strict=False):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        if not isinstance(following, ast.Expr) or not isinstance(following.value, ast.Constant):
            continue
        if isinstance(following.value.value, str):
            docstrings[statement.target.id] = " ".join(following.value.value.split())
    return docstrings


def _find_class(struct: type) -> ast.ClassDef | None:
    """Return the definition of a class in its source file, or None if there is no such file or definition."""
    module = sys.modules.get(struct.__module__)
    file = None if module is None else module.__file__
    if file is None:
        return None
    names = [name for name in struct.__qualname__.split(".") if name != "<locals>"]
    node: ast.AST = _parse_source(Path(file))
    for name in names:
        found = next((child for child in ast.walk(node) if _defines(child, name)), None)
        if found is None:
            return None
        node = found
    return node if isinstance(node, ast.ClassDef) else None


def _defines(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name


@cache
def _parse_source(path: Path) -> ast.Module:
    """Return the parsed source file, or an empty module if the file cannot be read, as with bytecode alone."""
    try:
        return ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return ast.Module(body=[], type_ignores=[])


# --- types, ranges, units and defaults -------------------------------------------------------------------------


def describe_type(info: inspect.Type) -> str:
    """Return the type of a value in a few words. Whether a field may be left out is not part of it."""
    words: list[str] = []
    for option in alternatives(info):
        name = _name_type(option)
        if name and name not in words:
            words.append(name)
    return " or ".join(words) or "any value"


def _name_type(option: inspect.Type) -> str:
    """Return the name of a type that is not a union; empty for None, which no TOML file contains."""
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
        case inspect.DictType(value_type=inspect.AnyType()):
            return "table"
        case inspect.DictType(value_type=value_type):
            return f"{_plural(describe_type(value_type))} by name"
        case inspect.ListType(item_type=inspect.AnyType()):
            return "list"
        case inspect.ListType(item_type=item_type):
            return f"list of {_plural(describe_type(item_type))}"
        case inspect.TupleType(item_types=item_types):
            return f"{len(item_types)} {_plural(describe_type(item_types[0]))}"
        case _:
            return "any value"


def _plural(words: str) -> str:
    if words[0].isdigit():  # such as `2 numbers`
        return f"[{words}]"
    return " or ".join(f"{word}s" for word in words.split(" or "))


def describe_range(info: inspect.Type) -> str:
    """Return what a value is limited to beyond its type; empty if all values are allowed."""
    limits: list[str] = []
    for option in alternatives(info):
        limit = _describe_limits(option)
        if limit and limit not in limits:
            limits.append(limit)
    return " or ".join(limits)


def _describe_limits(option: inspect.Type) -> str:
    match option:
        case inspect.FloatType() | inspect.IntType():
            bounds = ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
            return ", ".join(f"{sign} {_format_number(bound)}" for sign, bound in bounds if bound is not None)
        case inspect.LiteralType(values=values):
            return ", ".join(format_value(value) for value in values)
        case inspect.EnumType(cls=enum):
            return ", ".join(format_value(member.value) for member in enum)
        case inspect.StructType(tag_field=str()):
            return f"{option.tag_field} = {format_value(option.tag)}"
        case inspect.StrType():
            return _describe_length(option.min_length, option.max_length, "characters")
        case inspect.ListType():
            return _join_limits(_describe_length(option.min_length, option.max_length, "entries"), option.item_type)
        case inspect.DictType() if not isinstance(option.value_type, inspect.AnyType):
            return _join_limits("", option.value_type)
        case inspect.TupleType(item_types=item_types):
            return _join_limits("", item_types[0])
        case _:
            return ""


def _join_limits(limits: str, item_type: inspect.Type) -> str:
    """Return the limits of a container, followed by those of its items."""
    of_each = describe_range(item_type)
    return "; each ".join(part for part in (limits, of_each) if part)


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
    unit = _unit_of_type(info)
    if unit == "1":
        return ""
    if unit or not _holds_numbers(info):
        return unit
    return _unit_of_name(name)


def _unit_of_name(name: str) -> str:
    """Return the unit that a name ends with; empty if the end is only a part of a unit that is not in the table."""
    for suffix, unit in UNITS_BY_SUFFIX.items():
        if name.endswith(suffix):
            word_before = name.removesuffix(suffix).rpartition("_")[2]
            return "" if word_before in UNIT_WORDS else unit
    return ""


def _unit_of_type(info: inspect.Type) -> str:
    """Return the first unit in a type, also inside of unions, lists and tuples."""
    unit = unit_of(info)
    if unit:
        return unit
    if isinstance(info, inspect.Metadata):
        return _unit_of_type(info.type)
    inner_types = info.types if isinstance(info, inspect.UnionType) else _item_types(info)
    for inner in inner_types:
        unit = _unit_of_type(inner)
        if unit:
            return unit
    return ""


def _holds_numbers(info: inspect.Type) -> bool:
    for option in alternatives(info):
        if isinstance(option, inspect.FloatType | inspect.IntType):
            return True
        if any(_holds_numbers(inner) for inner in _item_types(option)):
            return True
    return False


def _item_types(option: inspect.Type) -> tuple[inspect.Type, ...]:
    match option:
        case inspect.ListType(item_type=item_type):
            return (item_type,)
        case inspect.TupleType(item_types=item_types):
            return item_types
        case inspect.DictType(value_type=value_type):
            return (value_type,)
        case _:
            return ()


def _describe_default(field: inspect.Field) -> str:
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
            return "{" + ", ".join(f"{key} = {format_value(entry)}" for key, entry in value.items()) + "}"
        case _:
            return json.dumps(value, ensure_ascii=False)


# --- JSON Schema -----------------------------------------------------------------------------------------------


def make_schema(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the JSON Schema of a Struct, with the description, default and unit of every field."""
    schema = msgspec.json.schema(struct)
    definitions: dict[str, Any] = schema.get("$defs", {})
    for definition in definitions.values():
        if "description" in definition:  # without its indentation, as Python itself removes it from 3.13 on
            definition["description"] = cleandoc(definition["description"])
    for part in list_structs(struct):
        full_name = f"{part.__module__}.{part.__qualname__}"
        name = full_name if full_name in definitions else part.__name__
        _complete_definition(definitions[name], part)
    return schema


def _complete_definition(definition: dict[str, Any], struct: type[msgspec.Struct]) -> None:
    """Add descriptions, defaults and units to the properties of one Struct."""
    descriptions = describe_fields(struct)
    for field in _type_info(struct).fields:
        name = field.encode_name
        added = definition["properties"][name]
        if name in descriptions:
            added["description"] = descriptions[name]
        if not field.required and "default" not in added:
            added["default"] = get_default(field)
        unit = find_unit(name, field.type)
        if unit and not _unit_of_type(field.type):
            added["unit"] = unit


def list_structs(struct: type[msgspec.Struct]) -> list[type[msgspec.Struct]]:
    """Return a Struct and all Structs inside of it, each once."""
    found: dict[type[msgspec.Struct], None] = {}
    waiting: list[inspect.Type] = [_type_info(struct)]
    while waiting:
        option = waiting.pop()
        if isinstance(option, inspect.StructType):
            if option.cls in found:
                continue
            found[option.cls] = None
            waiting += [alternative for field in option.fields for alternative in alternatives(field.type)]
        for inner in _item_types(option):
            waiting += alternatives(inner)
    return list(found)


def structs_in(info: inspect.Type) -> Iterator[inspect.StructType]:
    """Yield the Structs that a value may be, or that the entries of a list or of a table by name may be."""
    for option in alternatives(info):
        if isinstance(option, inspect.StructType):
            yield option
        elif isinstance(option, inspect.ListType | inspect.DictType):
            for inner in _item_types(option):
                yield from structs_in(inner)

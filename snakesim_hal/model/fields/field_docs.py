"""Describe the fields of a Struct for users: type, unit, range, default and meaning.

The meaning of a field is the string literal on the line after it. Python discards such a literal, so it costs nothing
at run time. Only the functions here read it, from the source file of the Struct's class. A field without such a literal
has the description of its type, if the type has one (`snakesim_hal.wire.quantities.describe`).
"""

import ast
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec
from msgspec import inspect

from snakesim_hal.model.fields.field_words import (
    describe_default,
    describe_range,
    describe_type,
    find_unit,
    format_value,
)
from snakesim_hal.model.files import FileStruct


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
    info = inspect_struct_type(struct)
    descriptions = collect_field_descriptions(struct)
    docs = [
        _document_field(field, descriptions.get(field.encode_name, "")) for field in info.fields
    ]
    if info.tag_field is None:
        return docs
    return [_document_tag(info), *docs]


@cache
def inspect_struct_type(struct: type[msgspec.Struct]) -> inspect.StructType:
    """Return the fields of a Struct with their types."""
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
        default=None if field.required else describe_default(field),
        description=description,
        type_info=field.type,
    )


@cache
def collect_field_descriptions(struct: type[msgspec.Struct]) -> dict[str, str]:
    """Collect the descriptions of a Struct's fields by name, including inherited fields.

    Fields without a description are missing, and so are all fields of a class whose source file cannot be read.

    Args:
        struct: Struct class.
    """
    descriptions: dict[str, str] = {}
    for field in inspect_struct_type(struct).fields:
        description = _get_type_description(field.type)
        if description:
            descriptions[field.encode_name] = description
    if issubclass(struct, FileStruct):
        for section in struct.exceptions_to:
            descriptions |= _collect_exception_descriptions(section)
    for base in reversed(struct.__mro__):
        if issubclass(base, msgspec.Struct) and base is not msgspec.Struct:
            descriptions |= _read_field_docstrings(base)
    names = [field.encode_name for field in inspect_struct_type(struct).fields]
    return {name: descriptions[name] for name in names if name in descriptions}


def _collect_exception_descriptions(section: type[msgspec.Struct]) -> dict[str, str]:
    """Return the descriptions of a section for all as they are for an exception to it: None has another meaning."""
    descriptions: dict[str, str] = {}
    for name, description in collect_field_descriptions(section).items():
        meaning, _, _ = description.partition(" None:")
        descriptions[name] = f"{meaning.removesuffix('.')}. None: as in the section for all."
    return descriptions


def _get_type_description(info: inspect.Type) -> str:
    if not isinstance(info, inspect.Metadata):
        return ""
    extra = info.extra_json_schema or {}
    return str(extra.get("description", ""))


def _read_field_docstrings(struct: type) -> dict[str, str]:
    """Return the string literals after the fields in the body of a class, each as one line, by the field's name."""
    definition = _find_class_definition(struct)
    if definition is None:
        return {}
    docstrings: dict[str, str] = {}
    for statement, next_statement in zip(definition.body, definition.body[1:], strict=False):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        if not isinstance(next_statement, ast.Expr) or not isinstance(
            next_statement.value, ast.Constant
        ):
            continue
        if isinstance(next_statement.value.value, str):
            docstrings[statement.target.id] = " ".join(next_statement.value.value.split())
    return docstrings


def _find_class_definition(struct: type) -> ast.ClassDef | None:
    """Return the definition of a class in its source file, or None if there is no such file or definition."""
    module = sys.modules.get(struct.__module__)
    file = None if module is None else module.__file__
    if file is None:
        return None
    names = [name for name in struct.__qualname__.split(".") if name != "<locals>"]
    node: ast.AST = _parse_source(Path(file))
    for name in names:
        found = next((child for child in ast.walk(node) if _is_definition_of(child, name)), None)
        if found is None:
            return None
        node = found
    return node if isinstance(node, ast.ClassDef) else None


def _is_definition_of(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name


@cache
def _parse_source(path: Path) -> ast.Module:
    """Return the parsed source file, or an empty module if the file cannot be read, as with bytecode alone."""
    try:
        return ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return ast.Module(body=[], type_ignores=[])

"""Find the first value of a file that its Struct does not allow, and describe types in words: for errors of `files`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from msgspec import inspect


@dataclass(frozen=True)
class TypeViolation:
    """The first part of a value that its expected type does not allow."""

    kind: Literal["unknown", "missing", "wrong"]
    key_path: list[str]  # names and list indices that lead from the whole value to the part
    value: Any = None  # if it is wrong
    expected_type: Any = None  # the type that is expected there
    reason: str = ""  # the reason that msgspec gives
    known_fields: Sequence[str] = ()  # the allowed fields beside an unknown one


def find_first_violation(
    value: Any, expected_type: Any, key_path: Sequence[str] = ()
) -> TypeViolation | None:
    """Return the innermost part of a value that is wrong by itself, or None if the value has the expected type.

    Args:
        value: Value as read from TOML or JSON.
        expected_type: Type that msgspec can check.
        key_path: Names and list indices that lead from the whole file to the value.
    """
    try:
        msgspec.convert(value, expected_type)
    except msgspec.ValidationError as error:
        reason = str(error)
    else:
        return None
    if isinstance(value, dict):
        violation = _find_section_violation(value, expected_type, key_path)
        if violation is not None:
            return violation
    for step, part, part_type in _iterate_parts(value, expected_type):
        violation = find_first_violation(part, part_type, [*key_path, step])
        if violation is not None:
            return violation
    return TypeViolation("wrong", list(key_path), value, expected_type, reason)


def _find_section_violation(
    section: dict[str, Any], expected_type: Any, key_path: Sequence[str]
) -> TypeViolation | None:
    """Return a violation by the names of the section's fields or its tag, or None if they are allowed."""
    structs = [
        option for option in _list_type_alternatives(expected_type) if _is_struct_type(option)
    ]
    if not structs:
        return None
    matching = [struct for struct in structs if _tag_matches(section, struct)]
    if not matching:
        return _make_tag_violation(section, structs, key_path)
    return _find_field_violation(section, matching[0], key_path)


def _find_field_violation(
    section: dict[str, Any], struct: type[msgspec.Struct], key_path: Sequence[str]
) -> TypeViolation | None:
    """Return the violation by an unknown field or a missing required field, or None if there is no such field."""
    config = struct.__struct_config__
    fields = msgspec.structs.fields(struct)
    known = [field.encode_name for field in fields]
    if config.tag_field:
        known.append(config.tag_field)
    if config.forbid_unknown_fields:
        for name in section:
            if name not in known:
                return TypeViolation("unknown", [*key_path, name], known_fields=known)
    for field in fields:
        if field.required and field.encode_name not in section:
            return TypeViolation(
                "missing", [*key_path, field.encode_name], expected_type=field.type
            )
    return None


def _make_tag_violation(
    section: dict[str, Any], structs: Sequence[type[msgspec.Struct]], key_path: Sequence[str]
) -> TypeViolation:
    """Return the violation of a section whose tag is missing, or belongs to none of the Structs."""
    tag_field = str(structs[0].__struct_config__.tag_field)
    tags = tuple(struct.__struct_config__.tag for struct in structs)
    allowed_tags = Literal[tags]
    if tag_field not in section:
        return TypeViolation("missing", [*key_path, tag_field], expected_type=allowed_tags)
    return TypeViolation(
        "wrong", [*key_path, tag_field], section[tag_field], allowed_tags, "there is no such kind"
    )


def _iterate_parts(value: Any, expected_type: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield every field of a section and every entry of a dictionary, list or tuple inside of a value.

    Args:
        value: Value as read from TOML or JSON.
        expected_type: Expected type of the value, which may be a union.

    Yields:
        Name or list index of the part, the part, and the expected type of the part.
    """
    for option in _list_type_alternatives(expected_type):
        container_type = get_origin(option)
        type_arguments = get_args(option)
        if isinstance(value, dict) and _is_struct_type(option) and _tag_matches(value, option):
            for field in msgspec.structs.fields(option):
                if field.encode_name in value:
                    yield field.encode_name, value[field.encode_name], field.type
        elif container_type is dict and isinstance(value, dict):
            _, value_type = type_arguments
            for key, part in value.items():
                yield key, part, value_type
        elif container_type is list and isinstance(value, list):
            (item_type,) = type_arguments
            for i, part in enumerate(value):
                yield str(i), part, item_type
        elif container_type is tuple and isinstance(value, list):
            for i, (part, part_type) in enumerate(zip(value, type_arguments, strict=False)):
                yield str(i), part, part_type


def _list_type_alternatives(expected_type: Any) -> list[Any]:
    """Return the alternatives of a union, without annotations; for any other type, only that type."""
    origin = get_origin(expected_type)
    if origin is Annotated:
        return _list_type_alternatives(get_args(expected_type)[0])
    if origin in (Union, UnionType):
        return [
            leaf for option in get_args(expected_type) for leaf in _list_type_alternatives(option)
        ]
    return [expected_type]


def _is_struct_type(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, msgspec.Struct)


def _tag_matches(section: dict[str, Any], struct: type[msgspec.Struct]) -> bool:
    """Return whether a section has the tag of a Struct; true for a Struct without a tag."""
    config = struct.__struct_config__
    if config.tag_field is None:
        return True
    return section.get(config.tag_field) == config.tag


def list_union_members(info: inspect.Type | None) -> list[inspect.Type]:
    """Return the alternatives of a union; for any other type, only that type."""
    if info is None:
        return []
    if isinstance(info, inspect.Metadata):
        return list_union_members(info.type)
    if isinstance(info, inspect.UnionType):
        return [leaf for option in info.types for leaf in list_union_members(option)]
    return [info]


def find_declared_unit(info: inspect.Type | None) -> str:
    """Return the unit that a number type declares, empty if it declares none. In a union, the first counts."""
    if isinstance(info, inspect.UnionType):
        for option in info.types:
            unit = find_declared_unit(option)
            if unit:
                return unit
        return ""
    if isinstance(info, inspect.Metadata):
        extra = info.extra_json_schema or {}
        return str(extra.get("unit", ""))
    return ""


def describe_type_in_words(info: inspect.Type | None) -> str:
    """Return the type of a field in words, such as "a number > 0 in m"."""
    unit = find_declared_unit(info)
    descriptions: list[str] = []
    for option in list_union_members(info):
        description = _describe_single_type(option, unit)
        if description is not None:
            descriptions.append(description)
    return " or ".join(descriptions) or "another value"


def _describe_single_type(option: inspect.Type, unit: str) -> str | None:
    """Describe a type that is not a union in words. Return None for a type that a file cannot contain, such as None."""
    match option:
        case inspect.FloatType() | inspect.IntType():
            return _describe_number(option, unit)
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
            names = [
                f"{option.tag_field} = {option.tag!r}",
                *(field.encode_name for field in fields),
            ]
            return "a section with " + ", ".join(names)
        case inspect.ListType():
            return f"a list, each {describe_type_in_words(option.item_type)}"
        case inspect.TupleType():
            return f"{len(option.item_types)} values, each {describe_type_in_words(option.item_types[0])}"
        case inspect.DictType():
            return "a section"
        case _:
            return None


def _describe_number(option: inspect.FloatType | inspect.IntType, unit: str) -> str:
    """Return a number in words, with its bounds and its unit."""
    words = ["a number" if isinstance(option, inspect.FloatType) else "a whole number"]
    limits = ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
    bounds = [f"{sign} {limit:g}" for sign, limit in limits if limit is not None]
    if bounds:
        words.append(" and ".join(bounds))
    if unit:
        words.append(f"in {unit}")
    return " ".join(words)

"""Find the first value of a file that its Struct does not allow, and describe types in words: for errors of `files`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from msgspec import inspect


@dataclass(frozen=True)
class Violation:
    """The first place where a value is not what its type allows."""

    kind: Literal["unknown", "missing", "wrong"]
    steps: list[str]  # names and numbers that lead from the whole value to the place
    value: Any = None  # if it is wrong
    expected: Any = None  # the type that is expected there
    why: str = ""  # the reason that msgspec gives
    known: Sequence[str] = ()  # the allowed fields beside an unknown one


def first_violation(value: Any, expected: Any, steps: Sequence[str] = ()) -> Violation | None:
    """Return the innermost part of a value that is wrong by itself, or None if the value has the expected type.

    Args:
        value: as read from TOML or JSON.
        expected: a type that msgspec can check.
        steps: the way from the whole file to the value.
    """
    try:
        msgspec.convert(value, expected)
    except msgspec.ValidationError as error:
        why = str(error)
    else:
        return None
    if isinstance(value, dict):
        violation = _violation_of_section(value, expected, steps)
        if violation is not None:
            return violation
    for step, part, part_type in _parts(value, expected):
        violation = first_violation(part, part_type, [*steps, step])
        if violation is not None:
            return violation
    return Violation("wrong", list(steps), value, expected, why)


def _violation_of_section(section: dict[str, Any], expected: Any, steps: Sequence[str]) -> Violation | None:
    """Return a violation by the section's own fields, not by what is inside of them."""
    structs = [option for option in _options(expected) if _is_struct(option)]
    if not structs:
        return None
    matching = [struct for struct in structs if _tag_matches(section, struct)]
    if not matching:
        return _violation_of_tag(section, structs, steps)
    return _violation_of_fields(section, matching[0], steps)


def _violation_of_fields(
    section: dict[str, Any], struct: type[msgspec.Struct], steps: Sequence[str]
) -> Violation | None:
    """Return a field that the Struct does not have, or one that is required and missing."""
    config = struct.__struct_config__
    fields = msgspec.structs.fields(struct)
    known = [field.encode_name for field in fields]
    if config.tag_field:
        known.append(config.tag_field)
    if config.forbid_unknown_fields:
        for name in section:
            if name not in known:
                return Violation("unknown", [*steps, name], known=known)
    for field in fields:
        if field.required and field.encode_name not in section:
            return Violation("missing", [*steps, field.encode_name], expected=field.type)
    return None


def _violation_of_tag(
    section: dict[str, Any], structs: Sequence[type[msgspec.Struct]], steps: Sequence[str]
) -> Violation:
    """Return the violation of a section whose tag is missing, or belongs to none of the Structs."""
    tag_field = str(structs[0].__struct_config__.tag_field)
    tags = tuple(struct.__struct_config__.tag for struct in structs)
    expected = Literal[tags]
    if tag_field not in section:
        return Violation("missing", [*steps, tag_field], expected=expected)
    return Violation("wrong", [*steps, tag_field], section[tag_field], expected, "there is no such kind")


def _parts(value: Any, expected: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield every field of a section and every entry of a dictionary, list or tuple inside of a value.

    Args:
        value: as read from TOML or JSON.
        expected: the expected type, which may be a union.

    Yields:
        The name or number of the part, the part itself, and the type that is expected of it.
    """
    for option in _options(expected):
        container = get_origin(option)
        arguments = get_args(option)
        if isinstance(value, dict) and _is_struct(option) and _tag_matches(value, option):
            for field in msgspec.structs.fields(option):
                if field.encode_name in value:
                    yield field.encode_name, value[field.encode_name], field.type
        elif container is dict and isinstance(value, dict):
            _, value_type = arguments
            for key, part in value.items():
                yield key, part, value_type
        elif container is list and isinstance(value, list):
            (item_type,) = arguments
            for i, part in enumerate(value):
                yield str(i), part, item_type
        elif container is tuple and isinstance(value, list):
            for i, (part, part_type) in enumerate(zip(value, arguments, strict=False)):
                yield str(i), part, part_type


def _options(expected: Any) -> list[Any]:
    """Return the alternatives of a union, without annotations; for any other type, only that type."""
    origin = get_origin(expected)
    if origin is Annotated:
        return _options(get_args(expected)[0])
    if origin in (Union, UnionType):
        return [leaf for option in get_args(expected) for leaf in _options(option)]
    return [expected]


def _is_struct(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, msgspec.Struct)


def _tag_matches(section: dict[str, Any], struct: type[msgspec.Struct]) -> bool:
    """Return whether a section has the tag of a Struct; true for a Struct without a tag."""
    config = struct.__struct_config__
    if config.tag_field is None:
        return True
    return section.get(config.tag_field) == config.tag


def alternatives(info: inspect.Type | None) -> list[inspect.Type]:
    """Return the alternatives of a union; for any other type, only that type."""
    if info is None:
        return []
    if isinstance(info, inspect.Metadata):
        return alternatives(info.type)
    if isinstance(info, inspect.UnionType):
        return [leaf for option in info.types for leaf in alternatives(option)]
    return [info]


def unit_of(info: inspect.Type | None) -> str:
    """Return the unit of a number; empty if it has no unit. Of a union, the first unit counts."""
    if isinstance(info, inspect.UnionType):
        for option in info.types:
            unit = unit_of(option)
            if unit:
                return unit
        return ""
    if isinstance(info, inspect.Metadata):
        extra = info.extra_json_schema or {}
        return str(extra.get("unit", ""))
    return ""


def in_words(info: inspect.Type | None) -> str:
    """Return the type of a field in words, such as "a number > 0 in m"."""
    unit = unit_of(info)
    descriptions: list[str] = []
    for option in alternatives(info):
        description = _describe(option, unit)
        if description is not None:
            descriptions.append(description)
    return " or ".join(descriptions) or "another value"


def _describe(option: inspect.Type, unit: str) -> str | None:
    """Return one type that is not a union in words; None if a file cannot contain it."""
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
            names = [f"{option.tag_field} = {option.tag!r}", *(field.encode_name for field in fields)]
            return "a section with " + ", ".join(names)
        case inspect.ListType():
            return f"a list, each {in_words(option.item_type)}"
        case inspect.TupleType():
            return f"{len(option.item_types)} values, each {in_words(option.item_types[0])}"
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

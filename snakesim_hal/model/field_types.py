"""Where a value of a file departs from its Struct, and what is wanted there in words: for the errors of `files`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
from msgspec import inspect


@dataclass(frozen=True)
class Violation:
    """The first place where a value is not what it should be."""

    kind: Literal["unknown", "missing", "wrong"]
    steps: list[str]  # the way to it
    value: Any = None
    wanted: Any = None  # type
    why: str = ""
    known: Sequence[str] = ()  # fields beside an unknown one


def first_violation(value: Any, wanted: Any, steps: Sequence[str] = ()) -> Violation | None:
    """None when the value is of the type; else the innermost part that is wrong by itself."""
    try:
        msgspec.convert(value, wanted)
    except msgspec.ValidationError as error:
        why = str(error)
    else:
        return None
    structs = [option for option in _options(wanted) if _is_struct(option)]
    if isinstance(value, dict) and structs:
        chosen = [struct for struct in structs if _is_meant(value, struct)]
        found = _flaw_of_section(value, chosen[0], steps) if chosen else _flaw_of_tag(value, structs, steps)
        if found is not None:
            return found
    for step, part, type_ in _parts(value, wanted):
        found = first_violation(part, type_, [*steps, step])
        if found is not None:
            return found
    return Violation("wrong", list(steps), value, wanted, why)


def _flaw_of_section(section: dict[str, Any], struct: type[msgspec.Struct], steps: Sequence[str]) -> Violation | None:
    """A field too many, or one too few."""
    config, fields = struct.__struct_config__, msgspec.structs.fields(struct)
    known = [field.encode_name for field in fields] + ([config.tag_field] if config.tag_field else [])
    for name in section if config.forbid_unknown_fields else ():
        if name not in known:
            return Violation("unknown", [*steps, name], known=known)
    for field in fields:
        if field.required and field.encode_name not in section:
            return Violation("missing", [*steps, field.encode_name], wanted=field.type)
    return None


def _flaw_of_tag(section: dict[str, Any], structs: Sequence[type[msgspec.Struct]], steps: Sequence[str]) -> Violation:
    tag = str(structs[0].__struct_config__.tag_field)
    wanted = Literal[tuple(struct.__struct_config__.tag for struct in structs)]
    if tag not in section:
        return Violation("missing", [*steps, tag], wanted=wanted)
    return Violation("wrong", [*steps, tag], section[tag], wanted, "there is no such kind")


def _parts(value: Any, wanted: Any) -> Iterator[tuple[str, Any, Any]]:
    """What is inside of a value: (step, part, wanted type)."""
    for option in _options(wanted):
        container, inner = get_origin(option), get_args(option)
        if isinstance(value, dict) and _is_struct(option) and _is_meant(value, option):
            for field in msgspec.structs.fields(option):
                if field.encode_name in value:
                    yield field.encode_name, value[field.encode_name], field.type
        elif container is dict and isinstance(value, dict):
            for key, part in value.items():
                yield key, part, inner[1]
        elif container is list and isinstance(value, list):
            for i, part in enumerate(value):
                yield str(i), part, inner[0]
        elif container is tuple and isinstance(value, list):
            for i, (part, type_) in enumerate(zip(value, inner, strict=False)):
                yield str(i), part, type_


def _options(wanted: Any) -> list[Any]:
    """The alternatives of a union, without their notes; one for any other type."""
    origin = get_origin(wanted)
    if origin is Annotated:
        return _options(get_args(wanted)[0])
    if origin in (Union, UnionType):
        return [leaf for option in get_args(wanted) for leaf in _options(option)]
    return [wanted]


def _is_struct(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, msgspec.Struct)


def _is_meant(section: dict[str, Any], struct: type[msgspec.Struct]) -> bool:
    """Whether a section is of this Struct, by its tag where it has one."""
    config = struct.__struct_config__
    return config.tag_field is None or section.get(config.tag_field) == config.tag


def _alternatives(info: inspect.Type | None) -> list[inspect.Type]:
    """The alternatives of a union; one for any other type."""
    if info is None:
        return []
    if isinstance(info, inspect.Metadata):
        return _alternatives(info.type)
    if isinstance(info, inspect.UnionType):
        return [leaf for option in info.types for leaf in _alternatives(option)]
    return [info]


def unit_of(info: inspect.Type | None) -> str:
    """The unit of a number; empty when it has none."""
    if isinstance(info, inspect.UnionType):
        return next(filter(None, map(unit_of, info.types)), "")
    if isinstance(info, inspect.Metadata):
        return str((info.extra_json_schema or {}).get("unit", ""))
    return ""


def in_words(info: inspect.Type | None) -> str:
    """The type of a field, in words."""
    said: list[str] = []
    for option in _alternatives(info):
        word = _word(option, unit_of(info))
        if word is not None:
            said.append(word)
    return " or ".join(said) or "another value"


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


def _number(option: inspect.FloatType | inspect.IntType, unit: str) -> str:
    word = "a number" if isinstance(option, inspect.FloatType) else "a whole number"
    signs = ((">=", option.ge), (">", option.gt), ("<=", option.le), ("<", option.lt))
    bounds = [f"{sign} {bound:g}" for sign, bound in signs if bound is not None]
    return " ".join(filter(None, [word, " and ".join(bounds), f"in {unit}" if unit else ""]))

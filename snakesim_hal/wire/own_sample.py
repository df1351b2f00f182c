"""The message of a sensor of one's own: a Struct that its author writes, and the same one made from its JSON Schema.

Whoever has the author's class uses that. Everybody else (host, recorder, console, bridges, tables) has the schema in
`Description.own`, so that nobody runs code because a robot or a recording names it. Fields are flat: numbers, flags,
words, texts, and lists of the first two; each with bounds, and numbers that are no counts with a unit.
"""

import math
import re
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from inspect import cleandoc
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, WireError, short
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Message, OwnSample
from snakesim_hal.wire.quantities import MAX_BEAMS, MAX_OWN_SCHEMA

MOST_FIELDS, LONGEST_TEXT = 32, 200
SHARED = frozenset(OwnSample.__struct_fields__)
UNBUILDABLE = (TypeError, ValueError, OverflowError, RecursionError)
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)
_BOUNDS = {"minimum": "ge", "exclusiveMinimum": "gt", "maximum": "le", "exclusiveMaximum": "lt"}


@dataclass(frozen=True)
class OwnKind:
    """What is known of such a message from its schema alone."""

    message: type[OwnSample]
    units: dict[str, str]  # of each field that is a number or has some; "1": a count, a flag or a ratio
    schema: str

    def numbers(self, sample: OwnSample) -> dict[str, float]:
        """By field, a list as `field.0`, `field.1` ...; NaN: null. Words and texts are left out."""
        found: dict[str, float] = {}
        for name in self.units:
            value = getattr(sample, name)
            if isinstance(value, list | tuple):
                found |= {f"{name}.{i}": _number(one) for i, one in enumerate(value)}
            else:
                found[name] = _number(value)
        return found


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def schema_of(message: Any, whose: str) -> str:
    """The JSON Schema of an author's message. whose: named in the error. Raises ConfigError for what cannot be one."""
    if not (isinstance(message, type) and issubclass(message, OwnSample) and message is not OwnSample):
        raise ConfigError(
            f"{whose}: `message` is {short(repr(message))}, must be a class derived from OwnSample of "
            "snakesim_hal.wire.messages, frozen and keyword-only"
        )
    try:
        schema = msgspec.json.schema(message)["$defs"][message.__name__]
        schema["description"] = cleandoc(schema.get("description", ""))[:LONGEST_TEXT]
        text = msgspec.json.encode(schema).decode()
        own_kind(text)
    except WireError as error:
        raise ConfigError(f"{whose}: {message.__name__}{error.detail}") from None
    except UNBUILDABLE as error:
        raise ConfigError(f"{whose}: {message.__name__} is no message: {error}") from None
    return text


@lru_cache(128)
def own_kind(schema: str) -> OwnKind:
    """The message that a schema describes. Raises WireError, whose detail begins with the field."""
    if len(schema) > MAX_OWN_SCHEMA:
        raise WireError("malformed", f" has a schema of {len(schema)} characters, at most {MAX_OWN_SCHEMA}")
    try:
        about = msgspec.json.decode(schema, type=dict[str, Any])
        fields = {name: one for name, one in about["properties"].items() if name not in SHARED}
        if not 0 < len(fields) <= MOST_FIELDS or not str(about["title"]).isidentifier():
            raise WireError("malformed", f" has {len(fields)} fields of its own, must have 1 to {MOST_FIELDS}")
        made: list[Any] = []
        units: dict[str, str] = {}
        for name, one in fields.items():
            if not _NAME.fullmatch(name) or hasattr(OwnSample, name):
                raise WireError("malformed", f".{short(name)} is no name of a field: lower case, at most 40 characters")
            kind = _type(one, f".{name}", units, name)
            made.append((name, kind) if name in about.get("required", ()) else (name, kind | None, None))
        message: Any = msgspec.defstruct(about["title"], made, bases=(OwnSample,), frozen=True, kw_only=True)
        msgspec.msgpack.Decoder(message)  # refuses bounds that it cannot check
    except (*UNBUILDABLE, KeyError, AttributeError, msgspec.DecodeError) as error:
        if isinstance(error, WireError):
            raise
        raise WireError("malformed", f" has a schema that cannot be used: {short(str(error))}") from None
    return OwnKind(message, units, schema)


def _type(about: dict[str, Any], where: str, units: dict[str, str], name: str, *, inside: bool = False) -> Any:
    """The type of a field. Notes its unit."""
    match about:
        case {"anyOf": [inner, {"type": "null"}]}:
            return _type(inner, where, units, name, inside=inside) | None
        case {"type": "number" | "integer"}:
            bounds = {ours: about[theirs] for theirs, ours in _BOUNDS.items() if theirs in about}
            if len(bounds) != 2 or not bounds.keys() & {"ge", "gt"}:
                raise WireError("malformed", f"{where} has no bounds on both sides; give it a type such as {EXAMPLE}")
            if about["type"] == "number" and not isinstance(about.get("unit"), str):
                raise WireError("malformed", f'{where} has no unit ("1" for a ratio); give it a type such as {EXAMPLE}')
            units[name] = about.get("unit", "1")[:20]
            plain = float if about["type"] == "number" else int
            return Annotated[plain, Meta(**bounds)]
        case {"type": "boolean"}:
            units[name] = "1"
            return bool
        case {"type": "array", "items": {} as each, "maxItems": int(most)} if not inside and most <= MAX_BEAMS:
            return Annotated[list[_type(each, where, units, name, inside=True)], Meta(max_length=most)]
        case {"type": "array", "prefixItems": [*each]} if not inside and 0 < len(each) <= MAX_BEAMS:
            return tuple[tuple(_type(one, where, units, name, inside=True) for one in each)]
        case {"type": "string", "maxLength": int(most)} if not inside:
            return Annotated[str, Meta(max_length=min(most, LONGEST_TEXT))]
        case {"enum": [*words]} if not inside and all(isinstance(word, str) for word in words):
            return Literal[tuple(words)]
        case _:
            raise WireError(
                "malformed",
                f"{where} is none of: a number, a flag, a list of either or a text with `max_length`, a Literal",
            )


EXAMPLE = 'Annotated[float, bounded(-1.6, 1.6, "rad")], or q.Angle, of snakesim_hal.wire.quantities'


def own_kind_at(key: str, robot: Description) -> OwnKind | None:
    """The message of a robot's own sensor; None: there is none at this key, or its schema is of no use."""
    with suppress(WireError):
        return own_kind(robot.own[key]) if key in robot.own else None
    return None


def own_kinds(robot: Description) -> dict[str, OwnKind]:
    """All of them, by key."""
    return {key: kind for key in robot.own if (kind := own_kind_at(key, robot)) is not None}


def message_of(key: str, robot: Description | None) -> type[Message] | None:
    """The message at a key: as the robot describes it, else that of the key space, as far as it is known."""
    own = None if robot is None else own_kind_at(key, robot)
    return keys.message_at(key) if own is None else own.message

"""The message of a custom sensor: a Struct that its author writes, and the same one made from its JSON Schema.

A process that has the author's class uses that. All others (host, recorder, console, bridges, tables) have the schema
in `RobotDescription.custom`, so that no process runs code because a robot or a recording names it. Fields are flat:
numbers, flags, words, texts, and lists of the first two; each with bounds, and numbers that are no counts with a unit.
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

from snakesim_hal.base.errors import ConfigError, WireError, shorten
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import CustomSample, Message, RobotDescription
from snakesim_hal.wire.quantities import MAX_BEAMS, MAX_CUSTOM_SCHEMA

MAX_FIELDS = 32
MAX_TEXT_LENGTH = 200  # characters of a text field, and of the description of a message
MAX_UNIT_LENGTH = 20  # characters
# More than a robot may have custom sensors, for programs that watch several robots.
SCHEMAS_CACHED = 128
SHARED_FIELDS = frozenset(CustomSample.__struct_fields__)
EXAMPLE = 'Annotated[float, bounded(-1.6, 1.6, "rad")], or q.Angle, of snakesim_hal.wire.quantities'
# What msgspec raises for a schema or a class that cannot become a message.
SCHEMA_ERRORS = (TypeError, ValueError, OverflowError, RecursionError)
_FIELD_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)
# The bounds of a number: as JSON Schema calls them, and as msgspec does.
_BOUNDS = {"minimum": "ge", "exclusiveMinimum": "gt", "maximum": "le", "exclusiveMaximum": "lt"}


@dataclass(frozen=True)
class CustomMessage:
    """What is known of a custom message from its schema alone."""

    message: type[CustomSample]
    units: dict[str, str]  # unit of each numeric field; "1": a count, a flag or a ratio
    schema: str

    def extract_numeric_values(self, sample: CustomSample) -> dict[str, float]:
        """Return the numbers of a sample by field, those of a list as `field.0`, `field.1` ...

        A null becomes NaN. Words and texts are left out.
        """
        numbers: dict[str, float] = {}
        for name in self.units:
            value = getattr(sample, name)
            if isinstance(value, list | tuple):
                for i, entry in enumerate(value):
                    numbers[f"{name}.{i}"] = _to_number(entry)
            else:
                numbers[name] = _to_number(value)
        return numbers


def _to_number(value: float | None) -> float:
    return math.nan if value is None else float(value)


# --- from a class to a schema, and back ------------------------------------------------------------------------


def make_message_schema(message: Any, whose: str) -> str:
    """Return the JSON Schema of the message class of a custom sensor, after a check that it is allowed.

    Args:
        message: Class of the message, as the author's plugin gives it.
        whose: Name of the sensor, which errors start with.

    Raises:
        ConfigError: The class cannot be a message.
    """
    if not (
        isinstance(message, type)
        and issubclass(message, CustomSample)
        and message is not CustomSample
    ):
        raise ConfigError(
            f"{whose}: `message` is {shorten(repr(message))}, must be a class derived from CustomSample of "
            "snakesim_hal.wire.messages, frozen and keyword-only",
            code="plugin/not-loadable",
        )
    try:
        schema = msgspec.json.schema(message)["$defs"][message.__name__]
        schema["description"] = cleandoc(schema.get("description", ""))[:MAX_TEXT_LENGTH]
        text = msgspec.json.encode(schema).decode()
        parse_custom_message(text)
    except WireError as error:
        raise ConfigError(
            f"{whose}: {message.__name__}{error.detail}", code="plugin/not-loadable"
        ) from None
    except SCHEMA_ERRORS as error:
        raise ConfigError(
            f"{whose}: {message.__name__} is no message: {error}", code="plugin/not-loadable"
        ) from None
    return text


@lru_cache(SCHEMAS_CACHED)
def parse_custom_message(schema: str) -> CustomMessage:
    """Return the message that a JSON Schema describes; the newest SCHEMAS_CACHED of them are cached.

    Args:
        schema: JSON Schema from a robot's description or a recording, which may be wrong or hostile.

    Raises:
        WireError: The schema does not describe an allowed message. The error's detail starts with the field.
    """
    if len(schema) > MAX_CUSTOM_SCHEMA:
        raise WireError(
            "malformed", f" has a schema of {len(schema)} characters, at most {MAX_CUSTOM_SCHEMA}"
        )
    try:
        return _build_custom_message(schema)
    except WireError:
        raise
    except (*SCHEMA_ERRORS, KeyError, AttributeError, msgspec.DecodeError) as error:
        raise WireError(
            "malformed", f" has a schema that cannot be used: {shorten(str(error))}"
        ) from None


def _build_custom_message(schema: str) -> CustomMessage:
    """Build the message class that a JSON Schema describes, and find the units of its fields.

    Args:
        schema: JSON Schema from another process, which may be anything. The caller turns all errors into a WireError.

    Raises:
        WireError: A field, or the number of fields, is not allowed in a message.
        KeyError, AttributeError, msgspec.DecodeError, or one of SCHEMA_ERRORS: the text is no schema of a message.
    """
    content = msgspec.json.decode(schema, type=dict[str, Any])
    fields = {
        name: field for name, field in content["properties"].items() if name not in SHARED_FIELDS
    }
    if not 0 < len(fields) <= MAX_FIELDS or not str(content["title"]).isidentifier():
        raise WireError(
            "malformed", f" has {len(fields)} fields of its own, must have 1 to {MAX_FIELDS}"
        )
    required = content.get("required", ())
    # As `msgspec.defstruct` wants them: (name, type), or (name, type, default).
    definitions: list[Any] = []
    units: dict[str, str] = {}
    for name, field in fields.items():
        if not _FIELD_NAME.fullmatch(name) or hasattr(CustomSample, name):
            raise WireError(
                "malformed",
                f".{shorten(name)} is no name of a field: lower case, at most 40 characters",
            )
        field_type = _make_field_type(field, name, units)
        if name in required:
            definitions.append((name, field_type))
        else:
            definitions.append((name, field_type | None, None))
    message: Any = msgspec.defstruct(
        content["title"], definitions, bases=(CustomSample,), frozen=True, kw_only=True
    )
    msgspec.msgpack.Decoder(message)  # raises for bounds that msgspec cannot check
    return CustomMessage(message, units, schema)


def _make_field_type(
    field: dict[str, Any], name: str, units: dict[str, str], *, in_list: bool = False
) -> Any:
    """Return the Python type of a field, and add the unit of a numeric field to `units`.

    Args:
        field: JSON Schema of the field, or of the entries of a list.
        name: Name of the field.
        units: Units by the name of the field, which are changed.
        in_list: Whether `field` describes the entries of a list.

    Raises:
        WireError: The type is not allowed.
    """
    match field:
        case {"anyOf": [inner, {"type": "null"}]}:
            return _make_field_type(inner, name, units, in_list=in_list) | None
        case {"type": "number" | "integer"}:
            return _make_number_type(field, name, units)
        case {"type": "boolean"}:
            units[name] = "1"
            return bool
        case {"type": "array", "items": {} as entry, "maxItems": int(max_length)} if (
            not in_list and max_length <= MAX_BEAMS
        ):
            entry_type: Any = _make_field_type(entry, name, units, in_list=True)
            return Annotated[list[entry_type], Meta(max_length=max_length)]
        case {"type": "array", "prefixItems": [*entries]} if (
            not in_list and 0 < len(entries) <= MAX_BEAMS
        ):
            entry_types = [_make_field_type(entry, name, units, in_list=True) for entry in entries]
            return tuple[tuple(entry_types)]
        case {"type": "string", "maxLength": int(max_length)} if not in_list:
            return Annotated[str, Meta(max_length=min(max_length, MAX_TEXT_LENGTH))]
        case {"enum": [*words]} if not in_list and all(isinstance(word, str) for word in words):
            return Literal[tuple(words)]
        case _:
            raise WireError(
                "malformed",
                f".{name} is none of: a number, a flag, a list of either or a text with `max_length`, a Literal",
            )


def _make_number_type(field: dict[str, Any], name: str, units: dict[str, str]) -> Any:
    """Return the type of a number with its bounds, and add its unit to `units`."""
    bounds = {
        msgspec_name: field[json_name]
        for json_name, msgspec_name in _BOUNDS.items()
        if json_name in field
    }
    if len(bounds) != 2 or not bounds.keys() & {"ge", "gt"}:
        raise WireError(
            "malformed", f".{name} has no bounds on both sides; give it a type such as {EXAMPLE}"
        )
    is_float = field["type"] == "number"
    if is_float and not isinstance(field.get("unit"), str):
        raise WireError(
            "malformed", f'.{name} has no unit ("1" for a ratio); give it a type such as {EXAMPLE}'
        )
    units[name] = field.get("unit", "1")[:MAX_UNIT_LENGTH]
    plain = float if is_float else int
    return Annotated[plain, Meta(**bounds)]


# --- of a robot ------------------------------------------------------------------------------------------------


def find_custom_message(key: str, robot: RobotDescription) -> CustomMessage | None:
    """Return the message of a robot's custom sensor; None if this key has none, or its schema is of no use."""
    if key not in robot.custom:
        return None
    with suppress(WireError):
        return parse_custom_message(robot.custom[key])
    return None


def find_custom_messages(robot: RobotDescription) -> dict[str, CustomMessage]:
    """Return the messages of all custom sensors of a robot, by key."""
    messages: dict[str, CustomMessage] = {}
    for key in robot.custom:
        message = find_custom_message(key, robot)
        if message is not None:
            messages[key] = message
    return messages


def find_message_type(key: str, robot: RobotDescription | None) -> type[Message] | None:
    """Return the message at a key: as the robot describes it if it is known, else that of the key space."""
    custom_message = None if robot is None else find_custom_message(key, robot)
    if custom_message is None:
        return keys.find_message(key)
    return custom_message.message

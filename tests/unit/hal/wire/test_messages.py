"""The set of messages is complete, and its numbers have units and fixed values."""

import re
from typing import Any

import msgspec
import pytest
from msgspec import inspect

from snakesim_hal.wire import keys, messages
from snakesim_hal.wire.messages import VERSIONS, JointMode, Message
from snakesim_testing.hal.strategies import iter_places, make_plain_example

each_message = pytest.mark.parametrize(
    "message", list(VERSIONS), ids=lambda message: message.__name__
)


def list_declared_messages() -> set[type[Message]]:
    """Return every message that the module declares, without base classes."""
    attributes = (getattr(messages, name) for name in dir(messages))
    return {
        attribute
        for attribute in attributes
        if isinstance(attribute, type)
        and issubclass(attribute, Message)
        and not any(
            subclass.__module__.startswith(messages.__name__)
            for subclass in attribute.__subclasses__()
        )
    }


def list_inner_structs(message: type[Message]) -> set[type[Any]]:
    """Return the classes of all Structs inside a message."""
    places = iter_places(make_plain_example(message), inspect.type_info(message))
    return {info.cls for _, info in places if isinstance(info, inspect.StructType)} - {message}


def test_messages_declared_are_published_or_part_of_one() -> None:
    inner = set[type[Any]]().union(*(list_inner_structs(message) for message in VERSIONS))
    assert list_declared_messages() == set(VERSIONS) | inner


def test_messages_equal_those_of_the_key_space() -> None:
    published = {row.message for row in keys.SPACE if row.message is not None}
    assert published | {messages.Answer} == set(VERSIONS)


@each_message
def test_messages_numbers_have_a_unit_in_type_or_name(message: type[Message]) -> None:
    """Require a unit in the published schema, or at the end of the name of the field."""
    schema = msgspec.json.schema_components([message])[1]
    for name, struct in schema.items():
        for field, field_schema in struct.get("properties", {}).items():
            for leaf in list_number_schemas(field_schema):
                assert "unit" in leaf or re.search(
                    "_(hz|s|m|kg|rad|nm|rad_s2|nm_s|per_rad)$", field
                ), (name, field)


def list_number_schemas(schema: Any) -> list[dict[str, Any]]:
    """Return all schemas of numbers inside a schema."""
    if isinstance(schema, dict):
        numbers = [schema] if schema.get("type") == "number" else []
        return numbers + [leaf for value in schema.values() for leaf in list_number_schemas(value)]
    if isinstance(schema, list):
        return [leaf for value in schema for leaf in list_number_schemas(value)]
    return []


def test_joint_modes_have_fixed_numbers() -> None:
    """Check the numbers, because other languages and recordings use them."""
    assert {mode.name: mode.value for mode in JointMode} == {
        "PASSIVE": 0,
        "POSITION": 1,
        "VELOCITY": 2,
        "TORQUE": 3,
    }


def test_messages_of_sensors_have_tick_and_timestamp() -> None:
    for row in keys.SPACE:
        if row.kind == "stream" and row.message is not None and row.key.startswith("sensor/"):
            assert {"tick", "timestamp_ns"} <= set(row.message.__struct_fields__), row.key

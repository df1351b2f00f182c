"""The message set: complete, frozen, and fit for readers of an older or a newer release."""

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


def declared() -> set[type[Message]]:
    """Every message that the module declares, without what they inherit from."""
    found = (getattr(messages, name) for name in dir(messages))
    return {
        thing
        for thing in found
        if isinstance(thing, type)
        and issubclass(thing, Message)
        and not any(one.__module__.startswith(messages.__name__) for one in thing.__subclasses__())
    }


def parts_of(message: type[Message]) -> set[type[Any]]:
    """Every Struct inside a message."""
    found = iter_places(make_plain_example(message), inspect.type_info(message))
    return {info.cls for _, info in found if isinstance(info, inspect.StructType)} - {message}


def test_every_declared_message_stands_alone_or_inside_one_that_does() -> None:
    inner = set[type[Any]]().union(*(parts_of(message) for message in VERSIONS))
    assert declared() == set(VERSIONS) | inner


def test_messages_and_key_space_cover_each_other() -> None:
    at_a_key = {row.message for row in keys.SPACE if row.message is not None}
    assert at_a_key | {messages.Answer} == set(VERSIONS)


@each_message
def test_numbers_carry_their_unit_in_type_or_name(message: type[Message]) -> None:
    """A float says its unit in the published schema, or its field's name ends in it."""
    schema = msgspec.json.schema_components([message])[1]
    for name, struct in schema.items():
        for field, about in struct.get("properties", {}).items():
            for leaf in floats_of(about):
                assert "unit" in leaf or re.search(
                    "_(hz|s|m|kg|rad|nm|rad_s2|nm_s|per_rad)$", field
                ), (name, field)


def floats_of(about: Any) -> list[dict[str, Any]]:
    if isinstance(about, dict):
        own = [about] if about.get("type") == "number" else []
        return own + [leaf for value in about.values() for leaf in floats_of(value)]
    return [leaf for value in about for leaf in floats_of(value)] if isinstance(about, list) else []


def test_modes_keep_their_numbers() -> None:
    """The numbers are the contract with other languages and with recordings."""
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

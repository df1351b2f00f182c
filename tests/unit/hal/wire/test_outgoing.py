"""A message that a reader would refuse is refused before it is sent, with field, value and allowed values."""

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import Contacts, Message, Trajectory
from snakesim_hal.wire.outgoing import encode_checked
from snakesim_testing.hal.strategies import (
    iter_places,
    list_invalid_values,
    make_plain_example,
    make_strategy,
    replace_at,
)

STREAM_KEYS = {
    row.message: row.key
    for row in keys.SPACE
    if row.kind == "stream" and row.message and "*" not in row.key
}
each_message = pytest.mark.parametrize("message", STREAM_KEYS, ids=lambda message: message.__name__)


@each_message
@given(data=st.data())
@settings(max_examples=10)
def test_outgoing_valid_message_is_sent_unchanged(
    message: type[Message], data: st.DataObject
) -> None:
    sent = data.draw(make_strategy(message))
    encoded = encode_checked(STREAM_KEYS[message], sent)
    assert encoded.payload == encode(sent)
    assert encoded.decoded == sent


@each_message
def test_outgoing_value_out_of_bounds_is_named_by_field(message: type[Message]) -> None:
    example = make_plain_example(message)
    for place, info in iter_places(example, inspect.type_info(message)):
        for invalid_value in list_invalid_values(info) if place else ():
            with pytest.raises(WireError) as refusal:
                encode_checked(
                    STREAM_KEYS[message], message(**replace_at(example, place, invalid_value))
                )
            assert refusal.value.detail.startswith(f"{message.__name__}.{place[0]}"), (
                place,
                invalid_value,
            )
            assert ", must be " in refusal.value.detail


def make_contacts(**invalid_fields: Any) -> Contacts:
    """Return three contacts, the last of them with wrong values."""
    example = make_plain_example(Contacts)
    contact = example["contacts"][0]
    return Contacts(**{**example, "contacts": [contact, contact, {**contact, **invalid_fields}]})


def make_trajectory(*points: Any) -> Trajectory:
    return Trajectory(**{**make_plain_example(Trajectory), "path_w": list(points)})


INFINITE = (1.0, math.inf)
SHORT = (1.0,)
ARRAY = np.ones(2)


@pytest.mark.parametrize(
    ("key", "message", "pattern"),
    [
        (
            keys.TRAJECTORY,
            make_trajectory((0.0, 0.0), INFINITE),
            r"path_w\[1\]\[1\] is inf, must be `float` <= ",
        ),
        (
            keys.TRAJECTORY,
            make_trajectory((0.0, 0.0), SHORT),
            r"path_w\[1\] is \(1\.0,\), must be `array` of length 2",
        ),
        (
            keys.TRAJECTORY,
            make_trajectory(ARRAY),
            r"path_w is \[array\(\[1\., 1\.\]\)\], must be plain Python .*\.tolist",
        ),
        (
            keys.TRAJECTORY,
            make_trajectory((0.0, 0.0)),
            r"path_w is \[\(0\.0, 0\.0\)\], must be `array` of length >= 2",
        ),
        (
            keys.CONTACTS,
            make_contacts(link=-1),
            r"^Contacts\.contacts\[2\]\.link is -1, must be `int` >= 0$",
        ),
        (keys.CONTACTS, make_trajectory(), r"^a Trajectory, must be a Contacts$"),
        ("sensor/poze", make_contacts(), r"^there is no such key; did you mean `sensor/pose`\?"),
    ],
)
def test_outgoing_refusal_shows_only_the_invalid_value(
    key: str, message: Message, pattern: str
) -> None:
    with pytest.raises(WireError) as refusal:
        encode_checked(key, message)
    assert re.search(pattern, refusal.value.detail), refusal.value.detail

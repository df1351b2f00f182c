"""Judged before it is sent: what a reader refuses is refused, and field, value and what is allowed are named."""

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

STREAMED = {
    row.message: row.key
    for row in keys.SPACE
    if row.kind == "stream" and row.message and "*" not in row.key
}
each_message = pytest.mark.parametrize("message", STREAMED, ids=lambda message: message.__name__)


@each_message
@given(data=st.data())
@settings(max_examples=10)
def test_outgoing_valid_message_is_sent_unchanged(
    message: type[Message], data: st.DataObject
) -> None:
    sent = data.draw(make_strategy(message))
    encoded = encode_checked(STREAMED[message], sent)
    assert encoded.payload == encode(sent)
    assert encoded.decoded == sent


@each_message
def test_outgoing_value_out_of_bounds_is_named_by_field(message: type[Message]) -> None:
    example = make_plain_example(message)
    for at, info in iter_places(example, inspect.type_info(message)):
        for poison in list_invalid_values(info) if at else ():
            with pytest.raises(WireError) as caught:
                encode_checked(STREAMED[message], message(**replace_at(example, at, poison)))
            assert caught.value.detail.startswith(f"{message.__name__}.{at[0]}"), (at, poison)
            assert ", must be " in caught.value.detail


def contacts(**wrong: Any) -> Contacts:
    example = make_plain_example(Contacts)
    one = example["contacts"][0]
    return Contacts(**{**example, "contacts": [one, one, {**one, **wrong}]})


def trajectory(*points: Any) -> Trajectory:
    return Trajectory(**{**make_plain_example(Trajectory), "path_w": list(points)})


INFINITE, SHORT, ARRAY = (1.0, math.inf), (1.0,), np.ones(2)


@pytest.mark.parametrize(
    ("key", "message", "words"),
    [
        (
            keys.TRAJECTORY,
            trajectory((0.0, 0.0), INFINITE),
            r"path_w\[1\]\[1\] is inf, must be `float` <= ",
        ),
        (
            keys.TRAJECTORY,
            trajectory((0.0, 0.0), SHORT),
            r"path_w\[1\] is \(1\.0,\), must be `array` of length 2",
        ),
        (
            keys.TRAJECTORY,
            trajectory(ARRAY),
            r"path_w is \[array\(\[1\., 1\.\]\)\], must be plain Python .*\.tolist",
        ),
        (
            keys.TRAJECTORY,
            trajectory((0.0, 0.0)),
            r"path_w is \[\(0\.0, 0\.0\)\], must be `array` of length >= 2",
        ),
        (
            keys.CONTACTS,
            contacts(link=-1),
            r"^Contacts\.contacts\[2\]\.link is -1, must be `int` >= 0$",
        ),
        (keys.CONTACTS, trajectory(), r"^a Trajectory, must be a Contacts$"),
        ("sensor/poze", contacts(), r"^there is no such key; did you mean `sensor/pose`\?"),
    ],
)
def test_the_wrong_value_is_shown_alone(key: str, message: Message, words: str) -> None:
    with pytest.raises(WireError) as caught:
        encode_checked(key, message)
    assert re.search(words, caught.value.detail), caught.value.detail

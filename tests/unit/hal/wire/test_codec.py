"""The codec: what is sent is what arrives, and whatever else arrives ends in a WireError and nothing worse."""

from functools import reduce
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from snakesim_hal.base.errors import WireError
from snakesim_hal.wire.codec import (
    ENCODING_PREFIX,
    MAX_PAYLOAD_BYTES,
    MessageDecoder,
    encode,
    format_encoding,
)
from snakesim_hal.wire.messages import (
    VERSIONS,
    Clock,
    ColorImage,
    DepthImage,
    JointCommand,
    JointMode,
    JointState,
    Message,
)
from snakesim_testing.hal.strategies import (
    iter_places,
    list_invalid_values,
    make_plain_example,
    make_strategy,
    replace_at,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.messages import raises_error

ALL = list(VERSIONS)
DECODERS: dict[type[Message], MessageDecoder[Any]] = {
    message: MessageDecoder(message) for message in ALL
}
each_message = pytest.mark.parametrize("message", ALL, ids=lambda message: message.__name__)


def take(message: type[Message], payload: bytes) -> Message | None:
    """What the decoder makes of bytes: a message of the right type, or None for a WireError `malformed`."""
    try:
        found = DECODERS[message].decode(payload, format_encoding(message))
    except WireError as error:
        assert error.reason == "malformed"
        return None
    assert type(found) is message
    return found


@each_message
@given(data=st.data())
@settings(max_examples=choose_trial_count(25))
def test_codec_round_trip_returns_an_equal_message(
    message: type[Message], data: st.DataObject
) -> None:
    sent = data.draw(make_strategy(message))
    payload = encode(sent)
    assert take(message, payload) == sent
    assert encode(take(message, payload)) == payload


@each_message
def test_every_field_refuses_what_is_out_of_its_bounds(message: type[Message]) -> None:
    example = make_plain_example(message)
    assert take(message, encode(example)) is not None
    for at, info in iter_places(example, inspect.type_info(message)):
        for poison in list_invalid_values(info):
            payload = encode(replace_at(example, at, poison))
            assert take(message, payload) is None, f"{message.__name__} {at} took {poison!r}"


@each_message
def test_no_number_and_no_list_of_the_contract_is_unbounded(message: type[Message]) -> None:
    for at, info in iter_places(make_plain_example(message), inspect.type_info(message)):
        if isinstance(info, inspect.FloatType | inspect.IntType):
            assert info.ge is not None or info.gt is not None, at
            assert info.le is not None or info.lt is not None, at
        if isinstance(info, inspect.ListType | inspect.DictType | inspect.StrType):
            assert info.max_length is not None, at


@each_message
def test_lists_longer_than_allowed_are_refused(message: type[Message]) -> None:
    example: Any = make_plain_example(message)
    for at, info in iter_places(example, inspect.type_info(message)):
        if isinstance(info, inspect.ListType) and info.max_length is not None:
            entry = reduce(lambda inner, step: inner[step], at, example)[0]
            assert (
                take(message, encode(replace_at(example, at, [entry] * info.max_length)))
                is not None
            ), at
            assert (
                take(message, encode(replace_at(example, at, [entry] * (info.max_length + 1))))
                is None
            ), at


@each_message
def test_codec_missing_required_field_is_refused_and_new_one_ignored(
    message: type[Message],
) -> None:
    example = make_plain_example(message)
    info = inspect.type_info(message)
    assert isinstance(info, inspect.StructType)
    for field in info.fields:
        rest = {key: value for key, value in example.items() if key != field.encode_name}
        assert (take(message, encode(rest)) is None) == field.required, field.name
    assert take(message, encode({**example, "of_a_later_release": [1, {"a": 2}]})) is not None


# --- foreign samples -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoding", "reason"),
    [
        (ENCODING_PREFIX + "JointCommand/2", "unknown_version"),
        (ENCODING_PREFIX + "JointCommand/0", "unknown_version"),
        (ENCODING_PREFIX + "JointCommand/", "unknown_version"),
        (ENCODING_PREFIX + "JointCommand", "unknown_message"),
        (ENCODING_PREFIX + "JointState/1", "unknown_message"),
        ("zenoh/bytes", "unknown_message"),
        ("application/json", "unknown_message"),
        ("", "unknown_message"),
        ("/" * 10_000, "unknown_message"),
    ],
)
def test_a_foreign_encoding_is_refused_with_its_reason(encoding: str, reason: str) -> None:
    payload = encode(make_plain_example(JointCommand))
    with pytest.raises(WireError) as caught:
        DECODERS[JointCommand].decode(payload, encoding)
    assert caught.value.reason == reason
    assert len(str(caught.value)) < 300


# --- malformed bytes -------------------------------------------------------------------------------------------


@each_message
def test_every_truncation_and_a_byte_too_many_are_refused(message: type[Message]) -> None:
    payload = encode(make_plain_example(message))
    assert take(message, payload) is not None
    for length in range(len(payload)):
        assert take(message, payload[:length]) is None, length
    assert take(message, payload + b"\x00") is None


@pytest.mark.parametrize("depth", [100, 10_000, 1_000_000])
@pytest.mark.parametrize("nest", [b"\x91", b"\x81\xa1a", b"\x81\xa8contacts\x91"])
def test_deep_nesting_is_refused(depth: int, nest: bytes) -> None:
    for message in (JointState, Clock):
        assert take(message, nest * depth) is None
        assert take(message, b"\x81\xa5other" + nest * depth) is None


def test_a_payload_above_the_size_limit_is_refused_unread() -> None:
    valid = make_plain_example(JointState)
    fits = encode({**valid, "other": b"x" * (MAX_PAYLOAD_BYTES - 1000)})
    assert take(JointState, fits) is not None
    too_large = encode({**valid, "other": b"x" * MAX_PAYLOAD_BYTES})
    with raises_error(WireError, code="message/rejected"):
        DECODERS[JointState].decode(too_large, format_encoding(JointState))


def test_codec_accepts_largest_images_and_no_other_large_message() -> None:
    for message, field, pixel in ((DepthImage, "depth", b"\1\2"), (ColorImage, "rgb", b"\1\2\3")):
        largest = {
            **make_plain_example(message),
            "width": 1280,
            "height": 960,
            field: pixel * (1280 * 960),
        }
        taken = take(message, encode(largest))
        assert taken is not None
        assert getattr(taken, field) == largest[field]
        assert take(message, encode({**largest, field: largest[field] + b"\1"})) is None
        assert (
            take(JointState, encode({**make_plain_example(JointState), "other": largest[field]}))
            is None
        )


def test_nobody_but_the_contract_can_write_a_mode() -> None:
    """A mode travels as its number, and only the four numbers of the contract are modes."""
    example = make_plain_example(JointCommand)
    for number in range(-2, 10):
        found = take(JointCommand, encode({**example, "mode": [number]}))
        assert (found is not None) == (number in set(JointMode))
    assert msgspec.msgpack.decode(encode([JointMode.TORQUE])) == [3]

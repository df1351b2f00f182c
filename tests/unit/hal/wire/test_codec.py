"""The codec decodes what it encodes, and any other bytes cause a WireError."""

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

MESSAGES = list(VERSIONS)
DECODERS: dict[type[Message], MessageDecoder[Any]] = {
    message: MessageDecoder(message) for message in MESSAGES
}
each_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.__name__)


def decode_or_none(message: type[Message], payload: bytes) -> Message | None:
    """Decode bytes, and return the message, or None for a WireError `malformed`."""
    try:
        decoded = DECODERS[message].decode(payload, format_encoding(message))
    except WireError as error:
        assert error.reason == "malformed"
        return None
    assert type(decoded) is message
    return decoded


@each_message
@given(data=st.data())
@settings(max_examples=choose_trial_count(25))
def test_codec_round_trip_returns_an_equal_message(
    message: type[Message], data: st.DataObject
) -> None:
    sent = data.draw(make_strategy(message))
    payload = encode(sent)
    assert decode_or_none(message, payload) == sent
    assert encode(decode_or_none(message, payload)) == payload


@each_message
def test_codec_value_out_of_bounds_is_refused_in_every_field(message: type[Message]) -> None:
    example = make_plain_example(message)
    assert decode_or_none(message, encode(example)) is not None
    for place, info in iter_places(example, inspect.type_info(message)):
        for invalid_value in list_invalid_values(info):
            payload = encode(replace_at(example, place, invalid_value))
            assert decode_or_none(message, payload) is None, (
                f"{message.__name__} {place} took {invalid_value!r}"
            )


@each_message
def test_codec_every_number_and_list_has_bounds(message: type[Message]) -> None:
    for place, info in iter_places(make_plain_example(message), inspect.type_info(message)):
        if isinstance(info, inspect.FloatType | inspect.IntType):
            assert info.ge is not None or info.gt is not None, place
            assert info.le is not None or info.lt is not None, place
        if isinstance(info, inspect.ListType | inspect.DictType | inspect.StrType):
            assert info.max_length is not None, place


@each_message
def test_codec_list_longer_than_allowed_is_refused(message: type[Message]) -> None:
    example: Any = make_plain_example(message)
    for place, info in iter_places(example, inspect.type_info(message)):
        if isinstance(info, inspect.ListType) and info.max_length is not None:
            entry = reduce(lambda container, step: container[step], place, example)[0]
            assert (
                decode_or_none(
                    message, encode(replace_at(example, place, [entry] * info.max_length))
                )
                is not None
            ), place
            assert (
                decode_or_none(
                    message, encode(replace_at(example, place, [entry] * (info.max_length + 1)))
                )
                is None
            ), place


@each_message
def test_codec_missing_required_field_is_refused_and_new_one_ignored(
    message: type[Message],
) -> None:
    example = make_plain_example(message)
    info = inspect.type_info(message)
    assert isinstance(info, inspect.StructType)
    for field in info.fields:
        other_fields = {key: value for key, value in example.items() if key != field.encode_name}
        assert (decode_or_none(message, encode(other_fields)) is None) == field.required, field.name
    assert (
        decode_or_none(message, encode({**example, "of_a_later_release": [1, {"a": 2}]}))
        is not None
    )


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
def test_codec_foreign_encoding_is_refused_with_its_reason(encoding: str, reason: str) -> None:
    payload = encode(make_plain_example(JointCommand))
    with pytest.raises(WireError) as refusal:
        DECODERS[JointCommand].decode(payload, encoding)
    assert refusal.value.reason == reason
    assert len(str(refusal.value)) < 300


# --- malformed bytes -------------------------------------------------------------------------------------------


@each_message
def test_codec_truncated_or_longer_payload_is_refused(message: type[Message]) -> None:
    payload = encode(make_plain_example(message))
    assert decode_or_none(message, payload) is not None
    for length in range(len(payload)):
        assert decode_or_none(message, payload[:length]) is None, length
    assert decode_or_none(message, payload + b"\x00") is None


@pytest.mark.parametrize("depth", [100, 10_000, 1_000_000])
@pytest.mark.parametrize("nest", [b"\x91", b"\x81\xa1a", b"\x81\xa8contacts\x91"])
def test_codec_deep_nesting_is_refused(depth: int, nest: bytes) -> None:
    for message in (JointState, Clock):
        assert decode_or_none(message, nest * depth) is None
        assert decode_or_none(message, b"\x81\xa5other" + nest * depth) is None


def test_codec_payload_above_the_size_limit_is_refused_unread() -> None:
    valid = make_plain_example(JointState)
    accepted_payload = encode({**valid, "other": b"x" * (MAX_PAYLOAD_BYTES - 1000)})
    assert decode_or_none(JointState, accepted_payload) is not None
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
        decoded = decode_or_none(message, encode(largest))
        assert decoded is not None
        assert getattr(decoded, field) == largest[field]
        assert decode_or_none(message, encode({**largest, field: largest[field] + b"\1"})) is None
        assert (
            decode_or_none(
                JointState, encode({**make_plain_example(JointState), "other": largest[field]})
            )
            is None
        )


def test_codec_unknown_mode_number_is_refused() -> None:
    """Accept only the four numbers of the contract, because a mode is encoded as its number."""
    example = make_plain_example(JointCommand)
    for number in range(-2, 10):
        decoded = decode_or_none(JointCommand, encode({**example, "mode": [number]}))
        assert (decoded is not None) == (number in set(JointMode))
    assert msgspec.msgpack.decode(encode([JointMode.TORQUE])) == [3]

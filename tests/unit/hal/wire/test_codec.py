"""The codec: what is sent is what arrives, and whatever else arrives ends in a WireError and nothing worse."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import inspect

from snakesim_hal.errors import WireError
from snakesim_hal.wire.codec import ENCODING_PREFIX, MAX_PAYLOAD_BYTES, Decoder, encode, encoding_of
from snakesim_hal.wire.messages import (
    VERSIONS,
    Clock,
    ColourImage,
    DepthImage,
    JointCommand,
    JointState,
    Message,
    Mode,
)
from tests.unit.hal.strategies import messages_of, places, plain_example, poisons, replaced

ALL = list(VERSIONS)
DECODERS: dict[type[Message], Decoder[Any]] = {message: Decoder(message) for message in ALL}
each_message = pytest.mark.parametrize("message", ALL, ids=lambda message: message.__name__)


def take(message: type[Message], payload: bytes) -> Message | None:
    """What the decoder makes of bytes: a message of the right type, or None for a WireError `malformed`."""
    try:
        found = DECODERS[message].decode(payload, encoding_of(message))
    except WireError as error:
        assert error.reason == "malformed"
        return None
    assert type(found) is message
    return found


@each_message
@given(data=st.data())
@settings(max_examples=25)
def test_round_trip(message: type[Message], data: st.DataObject) -> None:
    sent = data.draw(messages_of(message))
    payload = encode(sent)
    assert take(message, payload) == sent
    assert encode(take(message, payload)) == payload


@each_message
def test_every_field_refuses_what_is_out_of_its_bounds(message: type[Message]) -> None:
    example = plain_example(message)
    assert take(message, encode(example)) is not None
    for at, info in places(example, inspect.type_info(message)):
        for poison in poisons(info):
            payload = encode(replaced(example, at, poison))
            assert take(message, payload) is None, f"{message.__name__} {at} took {poison!r}"


@each_message
def test_no_number_and_no_list_of_the_contract_is_unbounded(message: type[Message]) -> None:
    for at, info in places(plain_example(message), inspect.type_info(message)):
        if isinstance(info, inspect.FloatType | inspect.IntType):
            assert info.ge is not None or info.gt is not None, at
            assert info.le is not None or info.lt is not None, at
        if isinstance(info, inspect.ListType | inspect.DictType | inspect.StrType):
            assert info.max_length is not None, at


@each_message
def test_lists_longer_than_allowed_are_refused(message: type[Message]) -> None:
    example = plain_example(message)
    for at, info in places(example, inspect.type_info(message)):
        if isinstance(info, inspect.ListType) and info.max_length is not None:
            entry = plain_entry(example, at)
            assert take(message, encode(replaced(example, at, [entry] * info.max_length))) is not None, at
            assert take(message, encode(replaced(example, at, [entry] * (info.max_length + 1)))) is None, at


def plain_entry(example: Any, at: tuple[str | int, ...]) -> Any:
    for step in at:
        example = example[step]
    return example[0]


@each_message
def test_a_missing_required_field_is_refused_and_a_new_one_ignored(message: type[Message]) -> None:
    example = plain_example(message)
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
    payload = encode(plain_example(JointCommand))
    with pytest.raises(WireError) as caught:
        DECODERS[JointCommand].decode(payload, encoding)
    assert caught.value.reason == reason
    assert len(str(caught.value)) < 300


def test_every_message_has_an_encoding_of_its_own_and_no_other_decoder_takes_it() -> None:
    assert len({encoding_of(message) for message in ALL}) == len(ALL)
    for sent in ALL:
        for wanted in ALL:
            if sent is not wanted:
                with pytest.raises(WireError, match="unknown_message"):
                    DECODERS[wanted].decode(encode(plain_example(sent)), encoding_of(sent))


def test_a_wire_error_is_also_a_value_error() -> None:
    with pytest.raises(ValueError, match="unknown_message"):
        DECODERS[Clock].decode(b"", "")


# --- malformed bytes -------------------------------------------------------------------------------------------


@given(message=st.sampled_from(ALL), payload=st.binary(max_size=200))
@settings(max_examples=1000)
def test_any_bytes_end_in_a_message_or_a_wire_error(message: type[Message], payload: bytes) -> None:
    take(message, payload)


@st.composite
def mutated(draw: st.DrawFn) -> tuple[type[Message], bytes]:
    """A valid payload with some bytes changed, put in, or taken out."""
    message = draw(st.sampled_from(ALL))
    payload = bytearray(encode(plain_example(message)))
    for _ in range(draw(st.integers(1, 4))):
        where = draw(st.integers(0, len(payload) - 1)) if payload else 0
        match draw(st.sampled_from(["change", "insert", "delete", "repeat"])):
            case "change" if payload:
                payload[where] = draw(st.integers(0, 255))
            case "insert":
                payload[where:where] = draw(st.binary(min_size=1, max_size=9))
            case "delete":
                del payload[where : where + draw(st.integers(1, 9))]
            case _:
                payload[where:where] = payload[: draw(st.integers(0, 60))]
    return message, bytes(payload)


@given(mutated())
@settings(max_examples=1500)
def test_mutations_of_valid_payloads_end_in_a_message_or_a_wire_error(case: tuple[type[Message], bytes]) -> None:
    message, payload = case
    found = take(message, payload)
    if found is not None:  # a mutation that is still valid is inside every bound: it survives another trip
        assert take(message, encode(found)) == found


@each_message
def test_every_truncation_is_refused(message: type[Message]) -> None:
    payload = encode(plain_example(message))
    assert take(message, payload) is not None
    for length in range(len(payload)):
        assert take(message, payload[:length]) is None, length


@each_message
def test_trailing_bytes_are_refused(message: type[Message]) -> None:
    assert take(message, encode(plain_example(message)) + b"\x00") is None


@pytest.mark.parametrize("depth", [100, 10_000, 1_000_000])
@pytest.mark.parametrize("nest", [b"\x91", b"\x81\xa1a", b"\x81\xa8contacts\x91"])
def test_deep_nesting_is_refused(depth: int, nest: bytes) -> None:
    for message in (JointState, Clock):
        assert take(message, nest * depth) is None
        assert take(message, b"\x81\xa5other" + nest * depth) is None


@pytest.mark.parametrize(
    "head", [b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"], ids=["array", "map", "str", "bin", "ext"]
)
def test_huge_lengths_are_refused_without_taking_the_memory(head: bytes) -> None:
    for prefix in (b"", b"\x81\xa9angle_rad", b"\x81\xa5other", b"\x81\xa6newest"):
        for message in (JointState, Clock):
            assert take(message, prefix + head + b"\xff\xff\xff\xff" + b"\x01" * 8) is None


def test_a_payload_above_the_size_limit_is_refused_unread() -> None:
    valid = plain_example(JointState)
    fits = encode({**valid, "other": b"x" * (MAX_PAYLOAD_BYTES - 1000)})
    assert take(JointState, fits) is not None
    too_large = encode({**valid, "other": b"x" * MAX_PAYLOAD_BYTES})
    with pytest.raises(WireError, match=str(MAX_PAYLOAD_BYTES)):
        DECODERS[JointState].decode(too_large, encoding_of(JointState))


def test_the_largest_images_are_taken_and_nothing_else_of_their_size() -> None:
    for message, field, pixel in ((DepthImage, "depth", b"\1\2"), (ColourImage, "rgb", b"\1\2\3")):
        largest = {**plain_example(message), "width": 1280, "height": 960, field: pixel * (1280 * 960)}
        taken = take(message, encode(largest))
        assert taken is not None and getattr(taken, field) == largest[field]
        assert take(message, encode({**largest, field: largest[field] + b"\1"})) is None
        assert take(JointState, encode({**plain_example(JointState), "other": largest[field]})) is None


def test_invalid_utf8_is_refused() -> None:
    payload = encode(plain_example(JointCommand)).replace(b"\xa6layout\xa1a", b"\xa6layout\xa1\xff")
    assert take(JointCommand, payload) is None


def test_nobody_but_the_contract_can_write_a_mode() -> None:
    """A mode travels as its number, and only the four numbers of the contract are modes."""
    example = plain_example(JointCommand)
    for number in range(-2, 10):
        found = take(JointCommand, encode({**example, "mode": [number]}))
        assert (found is not None) == (number in set(Mode))
    assert msgspec.msgpack.decode(encode([Mode.TORQUE])) == [3]

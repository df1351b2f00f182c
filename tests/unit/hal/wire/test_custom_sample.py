"""Messages of custom sensors have a schema that agrees with their class, and invalid schemas are refused."""

from typing import Annotated, Any

import msgspec
import pytest
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.custom_sample import make_message_schema, parse_custom_message
from snakesim_hal.wire.messages import CustomSample
from snakesim_testing.hal.custom_sample import MOUNTING, VALID_VALUES, SkinSample
from snakesim_testing.messages import raises_error


def test_custom_sample_is_decoded_from_its_schema_alone() -> None:
    kind = parse_custom_message(make_message_schema(SkinSample, "skin"))
    sample = SkinSample(**MOUNTING, **VALID_VALUES)
    decoded = MessageDecoder(kind.message).decode(encode(sample), format_encoding(SkinSample))
    assert msgspec.to_builtins(decoded) == msgspec.to_builtins(sample)
    assert kind.units == {"pressed_n": "N", "flow_m_s": "m/s", "wet": "1", "count": "1"}
    assert kind.extract_numeric_values(decoded) == pytest.approx(
        {"pressed_n.0": 1.5, "pressed_n.1": float("nan"), "wet": 1, "count": 4}
        | {f"flow_m_s.{i}": i + 1 for i in range(3)},
        nan_ok=True,
    )
    assert MessageDecoder(CustomSample).decode(
        encode(sample), format_encoding(SkinSample)
    ) == CustomSample(**MOUNTING)


@pytest.mark.parametrize(
    "invalid",
    [
        {"pressed_n": [1e9]},
        {"pressed_n": [1.0] * 4},
        {"flow_m_s": (1.0, 2.0)},
        {"wet": 1},
        {"count": 10},
        {"state": "hot"},
        {"note": "much too long"},
        {"link": -1},
    ],
    ids=lambda invalid: next(iter(invalid)),
)
def test_custom_sample_schema_refuses_the_same_values_as_class(invalid: dict[str, Any]) -> None:
    payload = msgspec.msgpack.encode(MOUNTING | VALID_VALUES | invalid)
    for message in (
        SkinSample,
        parse_custom_message(make_message_schema(SkinSample, "skin")).message,
    ):
        with pytest.raises(WireError) as refusal:
            MessageDecoder(message).decode(payload, format_encoding(SkinSample))
        assert next(iter(invalid)) in str(refusal.value)


class Unbounded(CustomSample, frozen=True, kw_only=True):
    bend_rad: float


class WithoutUnit(CustomSample, frozen=True, kw_only=True):
    bend: Annotated[float, Meta(ge=0, le=1)]


class Nested(CustomSample, frozen=True, kw_only=True):
    skin: SkinSample


class Empty(CustomSample, frozen=True, kw_only=True):
    """A message without fields of its own."""


@pytest.mark.parametrize(
    "message",
    [
        Unbounded,
        WithoutUnit,
        Nested,
        Empty,
        dict,
        None,
    ],
)
def test_custom_sample_without_checkable_schema_is_refused_before_start(message: Any) -> None:
    with raises_error(ConfigError, code="plugin/not-loadable", field="skin"):
        make_message_schema(message, "sensor 'skin': model x")


@pytest.mark.parametrize(
    "schema",
    [
        "",
        "[]",
        "{}",
        '{"title":"A","properties":5}',
        '{"title":"a b","properties":{"x":{"type":"boolean"}}}',
        '{"title":"A","properties":{"__init__":{"type":"boolean"}}}',
        '{"title":"A","properties":{"find_contradiction": {"type": "boolean"}}}',
        '{"title":"A","properties":{"x":{"type":"string","maxLength":5,"pattern":"(a+)+$"},"y":7}}',
        '{"title":"A","properties":{"x":{"type":"integer","minimum":"a","maximum":2}}}',
        '{"title":"A","properties":{"x":{"type":"integer","minimum":0,"maximum":1e400}}}',
        '{"title":"A","properties":{"x":{"type":"array","maxItems":999999999,"items":{"type":"boolean"}}}}',
        "[" * 9000,
    ],
)
def test_custom_sample_invalid_foreign_schema_is_refused(schema: str) -> None:
    with pytest.raises(WireError):
        parse_custom_message(schema)

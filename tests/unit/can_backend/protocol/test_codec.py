"""The codec encodes and decodes every signal of every message, and cantools uses the same bytes."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_can_backend.protocol.codec import (
    CodecError,
    FrameSignal,
    MessageLayout,
    load_database,
    load_layouts,
)
from snakesim_can_backend.protocol.definitions import (
    LAST_NODE,
    WITH_CHECKSUM,
    Opcode,
    checksum,
    has_valid_checksum,
    parse_node,
    parse_opcode,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.messages import raises_error

DATABASE = load_database()
TARGETS = ("position", "velocity", "torque")
ALL_SIGNALS = [
    (layout, signal)
    for layout in load_layouts().values()
    for signal in layout.signals.values()
    if signal.name != "checksum"
]
each_signal = pytest.mark.parametrize(
    ("layout", "signal"), ALL_SIGNALS, ids=[f"{m.name}.{s.name}" for m, s in ALL_SIGNALS]
)
LAYOUTS = list(load_layouts().values())
each_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
any_layout = st.sampled_from(LAYOUTS)
any_signal = st.sampled_from(ALL_SIGNALS)
many_examples = settings(max_examples=choose_trial_count(400))
any_node = st.integers(1, LAST_NODE)


def compute_tolerance(signal: FrameSignal, value: float) -> float:
    """Return the allowed error: half a step, and the rounding of double precision."""
    half_step = abs(value) * 2**-24 + 2**-150 if signal.is_float else signal.scale / 2
    return half_step * (1 + 1e-9) + 1e-12 * abs(value)


def make_raw_numbers(signal: FrameSignal) -> st.SearchStrategy[int]:
    """Return a strategy for the raw numbers of a signal."""
    if signal.is_float:
        return st.floats(-(2.0**127), 2.0**127, width=32).map(
            lambda v: FrameSignal.encode(signal, v)
        )
    return st.integers(
        round((signal.low - signal.offset) / signal.scale),
        round((signal.high - signal.offset) / signal.scale),
    )


@st.composite
def draw_contents(draw: st.DrawFn, layout: MessageLayout) -> dict[str, int]:
    """Draw raw numbers of the signals that a frame contains. A setpoint contains at most one target."""
    names = [name for name in layout.signals if name != "checksum"]
    numbers = {name: draw(make_raw_numbers(layout.signals[name])) for name in names}
    if layout.opcode == Opcode.SET_POINT:
        present_target = ("", *TARGETS)[numbers["mode"]]
        numbers = {
            name: number
            for name, number in numbers.items()
            if name not in TARGETS or name == present_target
        }
    return numbers


# --- signals -----------------------------------------------------------------------------------------------


@given(any_signal, st.data(), any_node)
@many_examples
def test_codec_value_is_decoded_within_half_a_step(
    layout_and_signal: tuple[MessageLayout, FrameSignal], data: st.DataObject, node: int
) -> None:
    layout, signal = layout_and_signal
    value = data.draw(st.floats(signal.low, signal.high))
    frame = layout.encode(node, **{signal.name: value})
    assert parse_opcode(frame.id) == layout.opcode
    assert parse_node(frame.id) == node
    assert len(frame.data) == layout.length
    assert abs(layout.decode(frame.data)[signal.name] - value) <= compute_tolerance(signal, value)


@each_signal
def test_codec_ends_of_a_range_are_encoded_and_decoded(
    layout: MessageLayout, signal: FrameSignal
) -> None:
    for end in (signal.low, signal.high):
        decoded = layout.decode(layout.encode(1, **{signal.name: end}).data)[signal.name]
        assert abs(decoded - end) <= compute_tolerance(signal, end)
        if not signal.is_float:
            assert decoded == pytest.approx(end, abs=1e-9 * max(abs(end), 1.0))


@each_signal
@pytest.mark.parametrize("invalid", ["above", "below", math.nan, math.inf, -math.inf])
def test_codec_value_out_of_range_is_refused(
    layout: MessageLayout, signal: FrameSignal, invalid: float | str
) -> None:
    step = 1e32 if signal.is_float else signal.scale
    if invalid == "above":
        value = signal.high + step
    elif invalid == "below":
        value = signal.low - step
    else:
        value = float(invalid)
    with pytest.raises(CodecError) as refusal:
        layout.encode(1, **{signal.name: value})
    assert isinstance(refusal.value, ValueError)
    for expected_text in (signal.name, str(value), signal.unit, str(signal.low), str(signal.high)):
        assert expected_text in str(refusal.value)


# --- against cantools --------------------------------------------------------------------------------------


@pytest.mark.slow
@given(any_layout, st.data(), any_node)
@many_examples
def test_codec_encodes_the_same_bytes_as_cantools(
    layout: MessageLayout, data: st.DataObject, node: int
) -> None:
    numbers = data.draw(draw_contents(layout))
    values = {
        name: min(max(signal.decode(numbers[name]), signal.low), signal.high)
        for name, signal in layout.signals.items()
        if name in numbers
    }
    frame = layout.encode(node, **values)
    cantools_values: dict[str, Any] = dict(values)
    if layout.opcode in WITH_CHECKSUM:
        cantools_values["checksum"] = frame.data[-1]
    assert DATABASE.encode_message(layout.name, cantools_values, strict=False) == frame.data


@given(any_layout, st.data())
@many_examples
def test_codec_decodes_any_bytes_as_cantools_does(
    layout: MessageLayout, data: st.DataObject
) -> None:
    content = data.draw(st.binary(min_size=layout.length, max_size=layout.length))
    if layout.opcode == Opcode.SET_POINT:
        # Cantools supports only these modes.
        content = bytes((content[0] & 0xF0 | content[0] & 0x03,)) + content[1:]
    decoded = layout.decode(content)
    decoded_by_cantools = DATABASE.decode_message(layout.name, content, decode_choices=False)
    assert isinstance(decoded_by_cantools, dict)
    for name, value in decoded_by_cantools.items():
        assert decoded[name] == pytest.approx(value, rel=1e-12, abs=1e-15, nan_ok=True), name


# --- frames ------------------------------------------------------------------------------------------------


@given(any_layout, st.data(), any_node)
@many_examples
def test_codec_reader_decodes_what_a_writer_encodes(
    layout: MessageLayout, data: st.DataObject, node: int
) -> None:
    numbers = data.draw(draw_contents(layout))
    names = data.draw(st.permutations(list(numbers)))
    frame = layout.make_writer(*names)(node, [numbers[name] for name in names])
    assert layout.make_reader(*names)(frame.data) == tuple(numbers[name] for name in names)
    if layout.opcode in WITH_CHECKSUM:
        assert has_valid_checksum(frame)
        assert frame.data[-1] == checksum(frame.id, frame.data[:-1])


@each_layout
def test_codec_unnamed_signals_are_zero(layout: MessageLayout) -> None:
    frame = layout.encode(7)
    payload = frame.data[:-1] if layout.opcode in WITH_CHECKSUM else frame.data
    assert not any(payload)


@each_layout
def test_codec_frame_of_another_length_is_refused(layout: MessageLayout) -> None:
    for length in set(range(9)) - {layout.length}:
        with raises_error(CodecError, code="message/rejected"):
            layout.decode(bytes(length))

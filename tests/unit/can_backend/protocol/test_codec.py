"""Every signal of every message goes over the bus and back, and cantools reads and writes the same bytes."""

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
EVERY_SIGNAL = [
    (layout, signal)
    for layout in load_layouts().values()
    for signal in layout.signals.values()
    if signal.name != "checksum"
]
each_signal = pytest.mark.parametrize(
    ("layout", "signal"), EVERY_SIGNAL, ids=[f"{m.name}.{s.name}" for m, s in EVERY_SIGNAL]
)
LAYOUTS = list(load_layouts().values())
each_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
any_layout, any_signal = st.sampled_from(LAYOUTS), st.sampled_from(EVERY_SIGNAL)
often = settings(max_examples=choose_trial_count(400))
nodes = st.integers(1, LAST_NODE)


def slack(signal: FrameSignal, value: float) -> float:
    """Half a step, and what double precision makes of it."""
    half = abs(value) * 2**-24 + 2**-150 if signal.is_float else signal.scale / 2
    return half * (1 + 1e-9) + 1e-12 * abs(value)


def raw_numbers(signal: FrameSignal) -> st.SearchStrategy[int]:
    if signal.is_float:
        return st.floats(-(2.0**127), 2.0**127, width=32).map(
            lambda v: FrameSignal.encode(signal, v)
        )
    return st.integers(
        round((signal.low - signal.offset) / signal.scale),
        round((signal.high - signal.offset) / signal.scale),
    )


@st.composite
def contents(draw: st.DrawFn, layout: MessageLayout) -> dict[str, int]:
    """Raw numbers of the signals that a frame really carries: of the targets of a setpoint one at most."""
    names = [name for name in layout.signals if name != "checksum"]
    numbers = {name: draw(raw_numbers(layout.signals[name])) for name in names}
    if layout.opcode == Opcode.SET_POINT:
        carried = ("", *TARGETS)[numbers["mode"]]
        numbers = {
            name: number
            for name, number in numbers.items()
            if name not in TARGETS or name == carried
        }
    return numbers


# --- signals -----------------------------------------------------------------------------------------------


@given(any_signal, st.data(), nodes)
@often
def test_every_value_comes_back_within_half_a_step(
    of: tuple[MessageLayout, FrameSignal], data: st.DataObject, node: int
) -> None:
    layout, signal = of
    value = data.draw(st.floats(signal.low, signal.high))
    frame = layout.encode(node, **{signal.name: value})
    assert parse_opcode(frame.id) == layout.opcode
    assert parse_node(frame.id) == node
    assert len(frame.data) == layout.length
    assert abs(layout.decode(frame.data)[signal.name] - value) <= slack(signal, value)


@each_signal
def test_both_ends_of_a_range_fit_and_come_back(layout: MessageLayout, signal: FrameSignal) -> None:
    for end in (signal.low, signal.high):
        back = layout.decode(layout.encode(1, **{signal.name: end}).data)[signal.name]
        assert abs(back - end) <= slack(signal, end)
        if not signal.is_float:
            assert back == pytest.approx(end, abs=1e-9 * max(abs(end), 1.0))


@each_signal
@pytest.mark.parametrize("wrong", ["above", "below", math.nan, math.inf, -math.inf])
def test_codec_value_out_of_range_is_refused(
    layout: MessageLayout, signal: FrameSignal, wrong: float | str
) -> None:
    step = 1e32 if signal.is_float else signal.scale
    value = (
        {"above": signal.high + step, "below": signal.low - step}[wrong]
        if isinstance(wrong, str)
        else wrong
    )
    with pytest.raises(CodecError) as caught:
        layout.encode(1, **{signal.name: value})
    assert isinstance(caught.value, ValueError)
    for part in (signal.name, str(value), signal.unit, str(signal.low), str(signal.high)):
        assert part in str(caught.value)


# --- against cantools --------------------------------------------------------------------------------------


@pytest.mark.slow
@given(any_layout, st.data(), nodes)
@often
def test_cantools_writes_the_same_bytes(
    layout: MessageLayout, data: st.DataObject, node: int
) -> None:
    numbers = data.draw(contents(layout))
    values = {
        n: min(max(s.decode(numbers[n]), s.low), s.high)
        for n, s in layout.signals.items()
        if n in numbers
    }
    frame = layout.encode(node, **values)
    theirs: dict[str, Any] = dict(values)
    if layout.opcode in WITH_CHECKSUM:
        theirs["checksum"] = frame.data[-1]
    assert DATABASE.encode_message(layout.name, theirs, strict=False) == frame.data


@given(any_layout, st.data())
@often
def test_any_bytes_are_read_as_cantools_reads_them(
    layout: MessageLayout, data: st.DataObject
) -> None:
    content = data.draw(st.binary(min_size=layout.length, max_size=layout.length))
    if layout.opcode == Opcode.SET_POINT:
        # Cantools knows no other mode.
        content = bytes((content[0] & 0xF0 | content[0] & 0x03,)) + content[1:]
    ours, theirs = (
        layout.decode(content),
        DATABASE.decode_message(layout.name, content, decode_choices=False),
    )
    assert isinstance(theirs, dict)
    for name, value in theirs.items():
        assert ours[name] == pytest.approx(value, rel=1e-12, abs=1e-15, nan_ok=True), name


# --- frames ------------------------------------------------------------------------------------------------


@given(any_layout, st.data(), nodes)
@often
def test_a_writer_writes_what_a_reader_reads(
    layout: MessageLayout, data: st.DataObject, node: int
) -> None:
    numbers = data.draw(contents(layout))
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
def test_a_frame_of_another_length_is_refused(layout: MessageLayout) -> None:
    for length in set(range(9)) - {layout.length}:
        with raises_error(CodecError, code="message/rejected"):
            layout.decode(bytes(length))

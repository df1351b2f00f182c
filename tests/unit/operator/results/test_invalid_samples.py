"""NaN, infinity and noise anywhere in the samples of a run: the report is still made, and says what is not known."""

import dataclasses
import math
import re
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from snakesim_hal.model.scenario import write_config
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.run_log.black_box import RowLayout
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import format_encoding
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.writer import RecordingWriter
from snakesim_operator.results.compare import page as compare_page
from snakesim_operator.results.compare.difference import compute_difference
from snakesim_operator.results.compare.table import format_comparison
from snakesim_operator.results.report import render_report
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.results.signals import get_recorded_signals
from snakesim_operator.results.summary import RunSummary, summarize_run
from snakesim_testing.operator.triplet_report import ReportReader, simulate_triplet

FIRST, LAST = 240, 330  # rows of the made-up run that are kept: two joints propel in them
FIRST_TICK = 37 + FIRST
JOINTS = [f"joint_{i + 1}" for i in range(13)]
SIGNALS = {
    "angle_rad": 13,
    "velocity_rad_s": 13,
    "torque_nm": 13,
    "target": 13,
    "torque_limit_nm": 13,
    "position_w_m": 3,
    "orientation_wxyz": 4,
    "time_s": 0,
    "contact_peak_n": 0,
    "contact_count": 0,
}
MAY_BE_NULL = {
    *("path_s_m", "propulsion_n", "propulsion_torque_nm", "torque_headroom_nm", "condition"),
    *("pose_timestamp_ns", "contacts_timestamp_ns", "last_seen_ns"),
}
WRONG_NUMBERS = [math.nan, math.inf, -math.inf, 1e300]
WRONG = st.sampled_from(WRONG_NUMBERS)


def write_record(folder: Path, record: RunRecord) -> None:
    """A record as a run leaves it."""
    write_config(record.config, folder / CONFIG_FILENAME)
    (folder / DESCRIPTION).write_bytes(msgspec.json.encode(record.description))
    (folder / HOST_RECORD).write_bytes(msgspec.json.encode(record.host))
    messages = [(keys.CONTROL_STATE, state) for state in record.control_states] + [
        (keys.WORLD, world) for world in record.worlds
    ]
    layout, count = RowLayout.for_robot(record.description), len(record.time_s)
    encoded = [(key, msgspec.msgpack.encode(message, enc_hook=float)) for key, message in messages]
    record_messages(folder, encoded, count)
    rows = bytearray(count * layout.row_bytes)
    columns = layout.decode_rows(rows)  # pyright: ignore[reportArgumentType]
    columns["tick"][:] = FIRST_TICK + np.arange(count)
    for column in layout.columns[1:]:
        columns[column.name][:] = getattr(record, column.name)
    (folder / BLACK_BOX).write_bytes(layout.encode_header() + rows)


def record_messages(folder: Path, payloads: list[tuple[str, bytes]], ticks: int) -> None:
    """A recording with these messages, and the setpoints of so many ticks, of which only the number is read."""
    (folder / RECORDING_FILENAME).unlink(missing_ok=True)
    recording = RecordingWriter(folder / RECORDING_FILENAME)
    for key, payload in [*payloads, *[(keys.APPLIED, b"")] * ticks]:
        message = keys.find_message(key)
        assert message is not None
        recording.write_arrival(ReceivedSample(key, payload, format_encoding(message), 0))
    recording.close({})


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    folder = tmp_path_factory.mktemp("base")
    whole = simulate_triplet()
    kept = {name: value[FIRST:LAST] for name, value in get_recorded_signals(whole).items()}
    begin_ns, end_ns = (round(kept["time_s"][i] * 1e9) for i in (0, -1))
    record = dataclasses.replace(
        whole,
        control_states=[
            state for state in whole.control_states if begin_ns <= state.timestamp_ns <= end_ns
        ],
        worlds=[world for world in whole.worlds if begin_ns <= world.timestamp_ns <= end_ns],
        host=msgspec.structs.replace(whole.host, ticks=LAST - FIRST),
        **kept,
    )
    write_record(folder, record)
    loaded = RunRecord.load(folder)
    assert loaded.missing == []
    assert "is incomplete" not in summary_and_page(loaded)[1].text
    return loaded


def summary_and_page(record: RunRecord) -> tuple[RunSummary, ReportReader]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        summary = summarize_run(record, "complete")
        reader = ReportReader(render_report(record, summary))
    numbers = [value for value in msgspec.structs.astuple(summary) if isinstance(value, float)]
    assert len(numbers) > 5
    assert all(map(math.isfinite, numbers))
    msgspec.json.decode(msgspec.json.encode(summary), type=RunSummary)
    assert not [
        a for a in reader.attributes if a[2] is not None and re.search(r"\b(nan|inf|None)\b", a[2])
    ]
    assert not re.search(r"\b(None|nan|inf)\b", reader.text)
    return summary, reader


def compared(a: RunRecord, b: RunRecord) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        difference = compute_difference(a, b)
        text = "\n".join(format_comparison(difference))
        reader = ReportReader(compare_page.render_comparison_page(difference))
    assert not re.search(r"\b(nan|inf)\b", text + reader.text)
    for record in (a, b):
        for lack in record.missing:
            assert lack in text
            assert lack in reader.text
    return text


@st.composite
def spoilt_cells(draw: st.DrawFn) -> list[tuple[str, slice, int, float]]:
    """Single samples, stretches, and whole columns."""
    found: list[tuple[str, slice, int, float]] = []
    for _ in range(draw(st.integers(1, 12))):
        signal = draw(st.sampled_from(sorted(SIGNALS)))
        first = draw(st.integers(0, LAST - FIRST - 1))
        rows = draw(
            st.sampled_from([slice(first, first + 1), slice(first, first + 20), slice(0, None)])
        )
        found.append((signal, rows, draw(st.integers(0, max(SIGNALS[signal] - 1, 0))), draw(WRONG)))
    return found


@given(cells=spoilt_cells())
@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_black_box_with_nan_is_summarized(base: RunRecord, tmp_path: Path, cells: Any) -> None:
    corrupted = {name: np.array(getattr(base, name)) for name in SIGNALS}
    for signal, rows, column, value in cells:
        place = corrupted[signal]
        place[(rows, column) if place.ndim > 1 else rows] = value
    write_record(tmp_path, dataclasses.replace(base, **corrupted))
    record = RunRecord.load(tmp_path)
    assert np.allclose(record.time_s, base.time_s)
    said = {line.partition(":")[0]: line for line in record.missing}
    for name, values in corrupted.items():
        bad = ~(np.abs(values) < 1e9)
        if name in ("position_w_m", "orientation_wxyz") or not bad.any():
            continue
        assert f"of {LAST - FIRST} samples are not numbers" in said[name]
        counts = zip(JOINTS, bad.sum(axis=0), strict=True) if values.ndim > 1 else [("", bad.sum())]
        assert all(f"{joint} {n}" in said[name] for joint, n in counts if n)
    summary, reader = summary_and_page(record)
    assert summary.missing == record.missing
    assert all(lack in reader.text for lack in record.missing)
    compared(base, record)
    compared(record, record)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Places of all numbers in a message."""
    if isinstance(value, dict | list):
        inner = value.items() if isinstance(value, dict) else enumerate(value)
        return [leaf for key, item in inner for leaf in leaves(item, (*path, key))]
    return [path] if isinstance(value, int | float) and not isinstance(value, bool) else []


@pytest.mark.slow  # the black box is read with the same checks
@given(data=st.data())
@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_recording_with_nan_is_summarized(
    base: RunRecord, tmp_path: Path, data: st.DataObject
) -> None:
    write_record(tmp_path, base)
    messages = [(keys.CONTROL_STATE, state) for state in base.control_states] + [
        (keys.WORLD, world) for world in base.worlds
    ]
    payloads = [(key, msgspec.msgpack.encode(message)) for key, message in messages]
    refused = 0
    for number in data.draw(st.sets(st.integers(0, len(payloads) - 1), min_size=1, max_size=8)):
        key, payload = payloads[number]
        whole = message = msgspec.msgpack.decode(payload)
        place = data.draw(st.sampled_from(leaves(message)))
        nulls = [None] if place[-1] in MAY_BE_NULL else []
        for part in place[:-1]:
            message = message[part]
        wrong = message[place[-1]] = data.draw(st.sampled_from([*WRONG_NUMBERS, "no", *nulls]))
        torn = data.draw(st.booleans())
        payloads[number] = key, msgspec.msgpack.encode(whole)[: -1 if torn else None]
        may_be_unknown = wrong is None and not torn
        refused += not may_be_unknown
    record_messages(tmp_path, payloads, len(base.time_s))
    record = RunRecord.load(tmp_path)
    assert len(record.control_states) + len(record.worlds) == len(payloads) - refused
    lacking = [re.match(r"recording: (\d+) messages? cannot be read, (control/state|guidance/world)", lack)
            for lack in record.missing]  # fmt: skip
    assert sum(int(found[1]) for found in lacking if found) == refused
    assert all(lacking)
    _, reader = summary_and_page(record)
    assert all(lack in reader.text for lack in record.missing)
    compared(record, base)


def test_unknown_pose_is_a_gap_only_with_a_pose_sensor(base: RunRecord, tmp_path: Path) -> None:
    def lacks(sensors: Any, unknown: slice) -> list[str]:
        position = base.position_w_m.copy()
        position[unknown] = np.nan
        robot = msgspec.structs.replace(base.config.robot, sensors=sensors)
        config = msgspec.structs.replace(base.config, robot=robot)
        write_record(tmp_path, dataclasses.replace(base, config=config, position_w_m=position))
        record = RunRecord.load(tmp_path)
        summary_and_page(record)
        return record.missing

    sensors = base.config.robot.sensors
    assert lacks(sensors, slice(0, 5)) == []
    assert lacks(sensors, slice(3, 5)) == ["position_w_m: 2 of 90 samples are not numbers"]
    assert lacks(sensors, slice(0, None)) == ["position_w_m: 90 of 90 samples are not numbers"]
    assert lacks(msgspec.structs.replace(sensors, pose=None), slice(0, None)) == []

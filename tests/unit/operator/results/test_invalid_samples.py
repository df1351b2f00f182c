"""Runs with NaN, infinity or damaged messages: the report is complete and names what is missing."""

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

# The tests keep these rows of the simulated run, in which two joints propel.
FIRST_ROW = 240
END_ROW = 330
ROW_COUNT = END_ROW - FIRST_ROW
FIRST_TICK = 37 + FIRST_ROW
JOINT_NAMES = [f"joint_{i + 1}" for i in range(13)]
COLUMN_COUNTS = {  # of each signal; 0: the signal has one dimension
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
OPTIONAL_FIELDS = {
    *("path_s_m", "propulsion_n", "propulsion_torque_nm", "torque_headroom_nm", "condition"),
    *("pose_timestamp_ns", "contacts_timestamp_ns", "last_seen_ns"),
}
INVALID_NUMBERS = [math.nan, math.inf, -math.inf, 1e300]
invalid_numbers = st.sampled_from(INVALID_NUMBERS)


def list_messages(record: RunRecord) -> list[tuple[str, Any]]:
    """List the control states and the world models of a record, each with its key."""
    messages: list[tuple[str, Any]] = []
    messages += [(keys.CONTROL_STATE, state) for state in record.control_states]
    messages += [(keys.WORLD, world) for world in record.worlds]
    return messages


def write_record(folder: Path, record: RunRecord) -> None:
    """Write the files of a run into a folder."""
    write_config(record.config, folder / CONFIG_FILENAME)
    (folder / DESCRIPTION).write_bytes(msgspec.json.encode(record.description))
    (folder / HOST_RECORD).write_bytes(msgspec.json.encode(record.host))
    row_count = len(record.time_s)
    payloads = [
        (key, msgspec.msgpack.encode(message, enc_hook=float))
        for key, message in list_messages(record)
    ]
    write_recording(folder, payloads, row_count)
    layout = RowLayout.for_robot(record.description)
    rows = bytearray(row_count * layout.row_bytes)
    columns = layout.decode_rows(rows)  # pyright: ignore[reportArgumentType]
    columns["tick"][:] = FIRST_TICK + np.arange(row_count)
    for column in layout.columns[1:]:
        columns[column.name][:] = getattr(record, column.name)
    (folder / BLACK_BOX).write_bytes(layout.encode_header() + rows)


def write_recording(folder: Path, payloads: list[tuple[str, bytes]], tick_count: int) -> None:
    """Write a recording with these messages and with an empty setpoint message for each tick.

    The reader only counts the setpoint messages.
    """
    (folder / RECORDING_FILENAME).unlink(missing_ok=True)
    writer = RecordingWriter(folder / RECORDING_FILENAME)
    for key, payload in [*payloads, *[(keys.APPLIED, b"")] * tick_count]:
        message = keys.find_message(key)
        assert message is not None
        writer.write_arrival(ReceivedSample(key, payload, format_encoding(message), 0))
    writer.close({})


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    """A short part of a simulated run without missing values, read from its files."""
    folder = tmp_path_factory.mktemp("base")
    full_run = simulate_triplet()
    signals = {
        name: values[FIRST_ROW:END_ROW] for name, values in get_recorded_signals(full_run).items()
    }
    start_ns = round(signals["time_s"][0] * 1e9)
    end_ns = round(signals["time_s"][-1] * 1e9)
    record = dataclasses.replace(
        full_run,
        control_states=[
            state for state in full_run.control_states if start_ns <= state.timestamp_ns <= end_ns
        ],
        worlds=[world for world in full_run.worlds if start_ns <= world.timestamp_ns <= end_ns],
        host=msgspec.structs.replace(full_run.host, ticks=ROW_COUNT),
        **signals,
    )
    write_record(folder, record)
    loaded = RunRecord.load(folder)
    assert loaded.missing == []
    _, page = make_summary_and_page(loaded)
    assert "is incomplete" not in page.text
    return loaded


def make_summary_and_page(record: RunRecord) -> tuple[RunSummary, ReportReader]:
    """Make the summary and the report without warnings, and check that neither shows a NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        summary = summarize_run(record, "complete")
        reader = ReportReader(render_report(record, summary))
    numbers = [value for value in msgspec.structs.astuple(summary) if isinstance(value, float)]
    assert len(numbers) > 5
    assert all(map(math.isfinite, numbers))
    msgspec.json.decode(msgspec.json.encode(summary), type=RunSummary)
    assert not [
        (tag, name, value)
        for tag, name, value in reader.attributes
        if value is not None and re.search(r"\b(nan|inf|None)\b", value)
    ]
    assert not re.search(r"\b(None|nan|inf)\b", reader.text)
    return summary, reader


def check_comparison(a: RunRecord, b: RunRecord) -> None:
    """Compare two runs, and check that text and page name all missing parts and show no NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        difference = compute_difference(a, b)
        text = "\n".join(format_comparison(difference))
        reader = ReportReader(compare_page.render_comparison_page(difference))
    assert not re.search(r"\b(nan|inf)\b", text + reader.text)
    for record in (a, b):
        for missing in record.missing:
            assert missing in text
            assert missing in reader.text


@st.composite
def invalid_cells(draw: st.DrawFn) -> list[tuple[str, slice, int, float]]:
    """Draw invalid values for single samples, for 20 samples, and for whole columns.

    Returns:
        The name of the signal, the rows, the column and the value of each change.
    """
    cells: list[tuple[str, slice, int, float]] = []
    for _ in range(draw(st.integers(1, 12))):
        signal = draw(st.sampled_from(sorted(COLUMN_COUNTS)))
        first = draw(st.integers(0, ROW_COUNT - 1))
        rows = draw(
            st.sampled_from([slice(first, first + 1), slice(first, first + 20), slice(0, None)])
        )
        column = draw(st.integers(0, max(COLUMN_COUNTS[signal] - 1, 0)))
        cells.append((signal, rows, column, draw(invalid_numbers)))
    return cells


@given(cells=invalid_cells())
@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_black_box_with_nan_is_summarized(base: RunRecord, tmp_path: Path, cells: Any) -> None:
    corrupted = {name: np.array(getattr(base, name)) for name in COLUMN_COUNTS}
    for signal, rows, column, value in cells:
        values = corrupted[signal]
        values[(rows, column) if values.ndim > 1 else rows] = value
    write_record(tmp_path, dataclasses.replace(base, **corrupted))
    record = RunRecord.load(tmp_path)
    assert np.allclose(record.time_s, base.time_s)
    missing_by_signal = {text.partition(":")[0]: text for text in record.missing}
    for name, values in corrupted.items():
        is_invalid = ~(np.abs(values) < 1e9)
        if name in ("position_w_m", "orientation_wxyz") or not is_invalid.any():
            continue
        assert f"of {ROW_COUNT} samples are not numbers" in missing_by_signal[name]
        if values.ndim > 1:
            counts = list(zip(JOINT_NAMES, is_invalid.sum(axis=0), strict=True))
        else:
            counts = [("", is_invalid.sum())]
        assert all(f"{joint} {n}" in missing_by_signal[name] for joint, n in counts if n)
    summary, reader = make_summary_and_page(record)
    assert summary.missing == record.missing
    assert all(missing in reader.text for missing in record.missing)
    check_comparison(base, record)
    check_comparison(record, record)


def list_number_paths(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """List the paths of all numbers in a decoded message, as tuples of keys and indices."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [
            number_path
            for key, item in items
            for number_path in list_number_paths(item, (*path, key))
        ]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [path] if is_number else []


@pytest.mark.slow  # the test of the black box contains the same checks
@given(data=st.data())
@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_recording_with_nan_is_summarized(
    base: RunRecord, tmp_path: Path, data: st.DataObject
) -> None:
    write_record(tmp_path, base)
    payloads = [(key, msgspec.msgpack.encode(message)) for key, message in list_messages(base)]
    refused_count = 0
    for number in data.draw(st.sets(st.integers(0, len(payloads) - 1), min_size=1, max_size=8)):
        key, payload = payloads[number]
        message = msgspec.msgpack.decode(payload)
        path = data.draw(st.sampled_from(list_number_paths(message)))
        *parents, field = path
        container = message
        for parent in parents:
            container = container[parent]
        nulls = [None] if field in OPTIONAL_FIELDS else []
        invalid = data.draw(st.sampled_from([*INVALID_NUMBERS, "no", *nulls]))
        container[field] = invalid
        is_truncated = data.draw(st.booleans())
        changed_payload = msgspec.msgpack.encode(message)
        if is_truncated:
            changed_payload = changed_payload[:-1]
        payloads[number] = (key, changed_payload)
        is_readable = invalid is None and not is_truncated
        refused_count += not is_readable
    write_recording(tmp_path, payloads, len(base.time_s))
    record = RunRecord.load(tmp_path)
    assert len(record.control_states) + len(record.worlds) == len(payloads) - refused_count
    unreadable = [
        re.match(
            r"recording: (\d+) messages? cannot be read, (control/state|guidance/world)", missing
        )
        for missing in record.missing
    ]
    assert sum(int(match[1]) for match in unreadable if match) == refused_count
    assert all(unreadable)
    _, reader = make_summary_and_page(record)
    assert all(missing in reader.text for missing in record.missing)
    check_comparison(record, base)


def test_unknown_pose_is_a_gap_only_with_a_pose_sensor(base: RunRecord, tmp_path: Path) -> None:
    def list_missing(sensors: Any, unknown: slice) -> list[str]:
        """Return what is missing from a run with these sensors and unknown positions."""
        position = base.position_w_m.copy()
        position[unknown] = np.nan
        robot = msgspec.structs.replace(base.config.robot, sensors=sensors)
        config = msgspec.structs.replace(base.config, robot=robot)
        write_record(tmp_path, dataclasses.replace(base, config=config, position_w_m=position))
        record = RunRecord.load(tmp_path)
        make_summary_and_page(record)
        return record.missing

    sensors = base.config.robot.sensors
    assert list_missing(sensors, slice(0, 5)) == []
    assert list_missing(sensors, slice(3, 5)) == ["position_w_m: 2 of 90 samples are not numbers"]
    assert list_missing(sensors, slice(0, None)) == [
        "position_w_m: 90 of 90 samples are not numbers"
    ]
    assert list_missing(msgspec.structs.replace(sensors, pose=None), slice(0, None)) == []

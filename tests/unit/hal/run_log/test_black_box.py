"""The black box records every tick, and its digest identifies the commands of the motors."""

import threading
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.black_box import BlackBox, compute_digest, read_black_box
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, JointMode
from snakesim_testing.hal.small_robots import (
    make_description,
    make_joint_state,
    make_link_contact,
    make_pose,
)
from snakesim_testing.messages import raises_error

ROBOT = make_description()


def make_output(
    target: float = 0.1, mode: JointMode = JointMode.POSITION, torque_limit: float = 4.0
) -> TickOutput:
    """Return the same setpoint for every joint."""
    return TickOutput(SafeSetpoints([mode] * 3, [target] * 3, [torque_limit] * 3), 1, {})


def compute_box_digest(*rows: tuple[int, TickOutput], angle: float = 0.0) -> str:
    """Record ticks, and return the digest of their commands."""
    box = BlackBox(ROBOT)
    for tick, output in rows:
        box.record_tick(tick, tick * 10_000_000, Samples(make_joint_state(ROBOT, angle)), output)
    return box.command_digest


def read_all_columns(box: BlackBox) -> dict[str, Any]:
    """Read all rows of a box, and return them as columns."""
    rows = bytearray()
    row, chunk = box.read_rows(0)
    while chunk:
        rows += chunk
        row, chunk = box.read_rows(row + len(chunk) // box.layout.row_bytes)
    return box.layout.decode_rows(bytes(rows))


LONG_RUN_TICKS = 9000  # several times what `read_rows` returns at once
FIRST_POSE_TICK = 2
TOUCH_TICK = 3
RELEASE_TICK = 6


@pytest.fixture(scope="module")
def long_run() -> BlackBox:
    """Return the record of a long run whose third joint and targets move steadily."""
    box = BlackBox(ROBOT)
    for tick in range(LONG_RUN_TICKS):
        other_samples: dict[str, Any] = {}
        if tick == FIRST_POSE_TICK:
            other_samples[keys.POSE] = make_pose(tick, position_w=(1.0, 2.0, 3.0))
        if tick == TOUCH_TICK:
            contacts = [
                make_link_contact(obstacle="a", force_l=(3.0, 4.0, 0.0)),
                make_link_contact(obstacle="a"),
                make_link_contact(obstacle="b"),
            ]
            other_samples[keys.CONTACTS] = Contacts(tick=tick, timestamp_ns=0, contacts=contacts)
        if tick == RELEASE_TICK:
            other_samples[keys.CONTACTS] = Contacts(tick=tick, timestamp_ns=0, contacts=[])
        joints = make_joint_state(ROBOT, [0.1, 0.2, 0.001 * tick], 2.0, [3.0, 4.0, 5.0])
        box.record_tick(
            tick,
            tick * 10_000_000,
            Samples(joints, other_samples),
            make_output(tick * 1e-4, JointMode.TORQUE),
        )
    return box


def test_black_box_of_long_run_has_every_tick(long_run: BlackBox) -> None:
    columns = read_all_columns(long_run)
    assert long_run.row_count == LONG_RUN_TICKS
    assert all(len(column) == LONG_RUN_TICKS for column in columns.values())
    assert columns["time_s"] == pytest.approx(0.01 * np.arange(LONG_RUN_TICKS))


def test_black_box_columns_of_long_run_have_its_command_digest(long_run: BlackBox) -> None:
    assert compute_digest(read_all_columns(long_run)) == long_run.command_digest


def test_black_box_of_long_run_has_joint_states(long_run: BlackBox) -> None:
    columns = read_all_columns(long_run)
    last_tick = LONG_RUN_TICKS - 1
    assert columns["angle_rad"][last_tick].tolist() == pytest.approx([0.1, 0.2, 0.001 * last_tick])
    assert columns["velocity_rad_s"][7].tolist() == [2.0] * 3
    assert columns["torque_nm"][7].tolist() == [3.0, 4.0, 5.0]


def test_black_box_of_long_run_has_setpoints(long_run: BlackBox) -> None:
    columns = read_all_columns(long_run)
    assert columns["target"][4321] == pytest.approx([0.4321] * 3)
    assert columns["torque_limit_nm"][0].tolist() == [4.0] * 3
    assert set(columns["mode"].flat) == {JointMode.TORQUE}


def test_black_box_pose_is_nan_before_the_first_pose(long_run: BlackBox) -> None:
    columns = read_all_columns(long_run)
    assert np.isnan(columns["position_w_m"][:FIRST_POSE_TICK]).all()
    ticks_with_pose = LONG_RUN_TICKS - FIRST_POSE_TICK
    assert columns["position_w_m"][FIRST_POSE_TICK:].tolist() == [[1.0, 2.0, 3.0]] * ticks_with_pose
    assert columns["orientation_wxyz"][5].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_black_box_contacts_are_kept_until_next_sample(long_run: BlackBox) -> None:
    columns = read_all_columns(long_run)
    force_n = 5.0  # norm of (3, 4, 0)
    obstacles = 2  # three contacts on obstacles "a" and "b"
    assert columns["contact_peak_n"][:8].tolist() == [0, 0, 0, force_n, force_n, force_n, 0, 0]
    assert columns["contact_count"][:8].tolist() == [0, 0, 0, obstacles, obstacles, obstacles, 0, 0]


def test_black_box_digest_depends_only_on_commands() -> None:
    expected = compute_box_digest((0, make_output()), (1, make_output()))
    assert compute_box_digest((0, make_output()), (1, make_output()), angle=0.5) == expected
    other_digests = [
        compute_box_digest((0, make_output())),
        compute_box_digest((0, make_output()), (2, make_output())),
        compute_box_digest((0, make_output()), (1, make_output(0.1 + 1e-15))),
        compute_box_digest((0, make_output()), (1, make_output(mode=JointMode.VELOCITY))),
        compute_box_digest((0, make_output()), (1, make_output(torque_limit=3.9))),
        compute_box_digest((1, make_output()), (0, make_output())),
    ]
    assert len({expected, *other_digests}) == 7


def write_box(box: BlackBox, path: Path, missing_bytes: int = 0) -> Path:
    """Write a box into a file, without its last bytes."""
    content = box.layout.encode_header() + box.read_rows(0)[1]
    path.write_bytes(content[: len(content) - missing_bytes])
    return path


@pytest.mark.parametrize("missing_bytes", [0, 1, 100])
def test_black_box_file_is_read_without_its_torn_row(tmp_path: Path, missing_bytes: int) -> None:
    box = BlackBox(ROBOT)
    for tick in range(5):
        box.record_tick(
            tick, tick * 10_000_000, Samples(make_joint_state(ROBOT, 0.3 * tick)), make_output()
        )
    layout, columns = read_black_box(write_box(box, tmp_path / "box", missing_bytes))
    assert layout.robot == "worm"
    assert layout.joints == ["joint_1", "joint_2", "joint_3"]
    all_columns = read_all_columns(box)
    assert set(columns) == set(all_columns)
    assert columns["tick"].tolist() == list(range(5 - bool(missing_bytes)))
    for name, column in columns.items():
        assert np.array_equal(column, all_columns[name][: len(column)], equal_nan=True), name
    assert (compute_digest(columns) == box.command_digest) == (not missing_bytes)


def test_black_box_of_run_that_never_armed_is_empty(tmp_path: Path) -> None:
    _, columns = read_black_box(write_box(BlackBox(ROBOT), tmp_path / "box"))
    assert columns["angle_rad"].shape == (0, 3)
    assert compute_digest(columns) == BlackBox(ROBOT).command_digest


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 100,
        b"{}\n",
        BlackBox(ROBOT).layout.encode_header()[:-50],
        BlackBox(ROBOT).layout.encode_header().replace(b'"row_bytes":', b'"row_bytes":1'),
        BlackBox(ROBOT).layout.encode_header().replace(b"<f8", b"<O8"),
        BlackBox(ROBOT).layout.encode_header().replace(b"blackbox/1", b"blackbox/2"),
        b"[" * 3_000_000,
    ],
)
def test_black_box_invalid_file_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "box").write_bytes(content)
    try:
        _, columns = read_black_box(tmp_path / "box")
    except ConfigError as error:
        assert str(tmp_path / "box") in str(error)
    else:  # rows that are wider than the columns contain padding
        assert all(len(column) == 0 for column in columns.values())
    with raises_error(ConfigError, code="recording/not-readable"):
        read_black_box(tmp_path / "gone")


def test_black_box_without_reader_keeps_the_newest_rows() -> None:
    box = BlackBox(ROBOT, memory_bytes=10 * BlackBox(ROBOT).layout.row_bytes)
    for tick in range(25):
        box.record_tick(tick, tick, Samples(make_joint_state(ROBOT, 0.001 * tick)), make_output())
    first, rows = box.read_rows(3)
    assert first == 16
    assert read_all_columns(box)["tick"].tolist() == list(range(16, 25))
    assert box.row_count == 25
    assert box.layout.decode_rows(rows)["angle_rad"][:, 1] == pytest.approx(
        [0.001 * tick for tick in range(16, 20)]
    )
    # The digest covers all rows, also those that were dropped.
    assert box.command_digest == compute_box_digest(*((tick, make_output()) for tick in range(25)))


def test_black_box_rows_are_whole_while_a_thread_reads() -> None:
    box = BlackBox(ROBOT, memory_bytes=50 * BlackBox(ROBOT).layout.row_bytes)
    count = 20_000
    is_over = threading.Event()
    torn_rows: list[int] = []

    def read_all_rows() -> None:
        row = 0
        while not is_over.is_set():
            first, rows = box.read_rows(row)
            columns = box.layout.decode_rows(rows)
            is_whole = columns["angle_rad"][:, 0] == columns["tick"]
            torn_rows.extend(columns["tick"][~is_whole].tolist())
            if len(rows) and columns["tick"][0] != first:
                torn_rows.append(first)
            row = first + len(columns["tick"])

    thread = threading.Thread(target=read_all_rows)
    thread.start()
    for tick in range(count):
        box.record_tick(tick, tick, Samples(make_joint_state(ROBOT, float(tick))), make_output())
    is_over.set()
    thread.join(10)
    assert torn_rows == []


def test_black_box_tick_has_constant_cost_and_memory() -> None:
    robot = make_description(chain__modules=100)
    box = BlackBox(robot, memory_bytes=100 * BlackBox(robot).layout.row_bytes)
    samples = Samples(make_joint_state(robot, 0.1))
    output = TickOutput(SafeSetpoints([JointMode.POSITION] * 100, [0.1] * 100, [4.0] * 100), 1, {})
    for tick in range(300):
        box.record_tick(tick, tick, samples, output)
    peaks = [0] * 700
    tracemalloc.start()
    memory_before = tracemalloc.get_traced_memory()[0]
    for i in range(len(peaks)):
        tracemalloc.reset_peak()
        box.record_tick(300 + i, i, samples, output)
        peaks[i] = (
            tracemalloc.get_traced_memory()[1] - memory_before - 36 * i
        )  # numbers in the list `peaks`
    kept_memory = tracemalloc.get_traced_memory()[0] - memory_before - 36 * len(peaks)
    tracemalloc.stop()
    assert max(peaks) < 20_000
    assert kept_memory < 2_000


def test_black_box_keeps_mean_force_where_sensor_measures_it() -> None:
    box = BlackBox(ROBOT)
    contacts = Contacts(
        tick=0,
        timestamp_ns=0,
        contacts=[make_link_contact(force_l=(3.0, 4.0, 0.0))],
        measured_force_n=1.5,
    )
    box.record_tick(
        0,
        0,
        Samples(make_joint_state(ROBOT, 0.0, 0.0, 0.0), {keys.CONTACTS: contacts}),
        make_output(),
    )
    assert read_all_columns(box)["contact_peak_n"].tolist() == [1.5]

"""Logs of a bus, as candump writes them and as it prints them; whole, and cut by a power loss."""

import gzip
from pathlib import Path

import can
import pytest

from snakesim_can_backend.bus.read_log import BusLog
from snakesim_hal.base.errors import ConfigError
from snakesim_testing.messages import raises_error

COMPACT = """\
(1700000000.000000) can0 105#0011223344556677 R
(1700000000.000100) can0 080#0102030405 T
(1700000000.000200) can0 00008001##10A0B R
(1700000000.000300) can0 0C1#R
(1700000000.000400) can0 20000080#0004000000000000
(1700000000.000500) can0 7FF#
"""
PRINTED = {  # by the option of candump
    "-t a": """\
 (1700000000.000000)  can0  105   [8]  00 11 22 33 44 55 66 77
 (1700000000.000100)  can0  080   [5]  01 02 03 04 05
 (1700000000.000300)  can0  0C1   [0]  remote request
""",
    "-t A": """\
 (2023-11-14 22:13:20.000000)  can0  105   [8]  00 11 22 33 44 55 66 77
 (2023-11-14 22:13:20.000100)  can0  080   [5]  01 02 03 04 05
 (2023-11-14 22:13:20.000300)  can0  0C1   [0]  remote request
""",
    "-t d": """\
 (000.000000)  can0  105   [8]  00 11 22 33 44 55 66 77
 (000.000100)  can0  080   [5]  01 02 03 04 05
 (000.000200)  can0  0C1   [0]  remote request
 (000.000100)  can0  0C2   [0]  remote request
""",
    "-x -a": """\
  can0  RX - -  105   [8]  00 11 22 33 44 55 66 77   '.."3DUfw'
  can0  TX - -  080   [5]  01 02 03 04 05            '.....'
  can0  RX - -  0C1   [0]  remote request
""",
    "": """\
  can0  105   [8]  00 11 22 33 44 55 66 77
  can0  080   [5]  01 02 03 04 05
  can0  0C1   [0]  remote request
""",
}


def log_of(folder: Path, text: str | bytes, name: str = "bus.log") -> BusLog:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return BusLog(path)


def test_a_log_is_read_as_python_can_reads_it(tmp_path: Path) -> None:
    log = log_of(tmp_path, COMPACT)
    with can.LogReader(log.path) as theirs:
        for ours, other in zip(log, theirs, strict=True):
            assert ours.equals(other, timestamp_delta=0.0, check_channel=not ours.is_error_frame), (
                ours,
                other,
            )
    assert list(log.report()) == []
    packed = log_of(tmp_path, gzip.compress(COMPACT.encode()), "bus.log.gz")
    assert len(list(packed)) == 6
    assert list(packed.report()) == []


@pytest.mark.parametrize("option", PRINTED)
def test_what_candump_prints_is_read_with_its_times(tmp_path: Path, option: str) -> None:
    log = log_of(tmp_path, PRINTED[option])
    state, sync, remote = list(log)[:3]
    assert state.arbitration_id == 0x105
    assert bytes(state.data) == bytes.fromhex("0011223344556677")
    assert sync.arbitration_id == 0x080
    assert bytes(sync.data) == bytes.fromhex("0102030405")
    assert remote.is_remote_frame
    assert not state.is_remote_frame
    assert sync.is_rx == (option != "-x -a")
    if option in ("-x -a", ""):
        assert state.timestamp < sync.timestamp < remote.timestamp
        assert list(log.report()) == [
            "the frames have no times (candump -t a has): an answer counts as in time until the next Sync"
        ]
        return
    assert sync.timestamp - state.timestamp == pytest.approx(1e-4, abs=2e-6)
    assert remote.timestamp - state.timestamp == pytest.approx(3e-4, abs=2e-6)
    assert list(log.report()) == []


@pytest.mark.parametrize(
    ("cut", "frames", "report"),
    [
        (
            COMPACT + "(1700000000.000600) can0 105#00112233",
            6,
            "line 7: '(1700000000.000600) can0 105#00112233'",
        ),
        (
            COMPACT + "(1700000000.000600) can0 105#0011223 ",
            6,
            "line 7: '(1700000000.000600) can0 105#0011223 '",
        ),
        (COMPACT + "(17000000", 6, "line 7: '(17000000'"),
        (COMPACT + "\0" * 5000, 6, "line 7: '\\x00"),
        (
            PRINTED[""] + "  can0  105   [8]  00 11 22 3",
            3,
            "line 4: '  can0  105   [8]  00 11 22 3'",
        ),
        (COMPACT[:70] + "\0\0\0\n" + COMPACT, 7, "line 2: "),
    ],
)
def test_read_log_of_cut_file_names_the_dropped_line(
    tmp_path: Path, cut: str, frames: int, report: str
) -> None:
    log = log_of(tmp_path, cut)
    assert len(list(log)) == frames
    line = next(iter(log.report()))
    assert line.startswith(f"1 line is no whole frame and was left out: {report}")
    assert len(line) < 200


def test_read_log_last_line_without_newline_is_accepted_with_direction(tmp_path: Path) -> None:
    log = log_of(tmp_path, COMPACT.splitlines()[0])
    assert len(list(log)) == 1
    assert list(log.report()) == []


def test_many_dropped_lines_are_counted(tmp_path: Path) -> None:
    log = log_of(tmp_path, COMPACT + "noise\n" * 10)
    assert len(list(log)) == 6
    assert list(log.report()) == [
        "10 lines are no whole frames and were left out: line 7: 'noise'; line 8: 'noise'; line 9: 'noise'; and 7 more"
    ]


def test_a_cut_file_of_another_kind_gives_what_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "bus.asc"
    with can.LogReader(log_of(tmp_path, COMPACT).path) as frames, can.Logger(path) as other:
        for frame in frames:
            other(frame)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-2])[:-20] + b"zz\n")
    log = BusLog(path)
    assert len(list(log)) >= 3
    packed = tmp_path / "bus.log.gz"
    packed.write_bytes(gzip.compress(COMPACT.encode() * 1000)[:-300])
    log = BusLog(packed)
    assert len(list(log)) > 100
    assert "1 line is no whole" in next(iter(log.report()))


@pytest.mark.parametrize("text", ["not a frame\n", "\0" * 100, "(nan) can0 105#00\n"])
def test_a_file_without_a_frame_is_refused(tmp_path: Path, text: str) -> None:
    with raises_error(ConfigError, code="recording/not-readable"):
        list(log_of(tmp_path, text))
    with raises_error(ConfigError, code="recording/not-readable"):
        list(BusLog(tmp_path / "nothing.log"))

"""Bus logs are read as candump writes and prints them, also if a power loss has cut the file."""

import gzip
from pathlib import Path

import can
import pytest

from snakesim_can_backend.bus.read_log import BusLog
from snakesim_hal.base.errors import ConfigError
from snakesim_testing.messages import raises_error

LOG_LINES = """\
(1700000000.000000) can0 105#0011223344556677 R
(1700000000.000100) can0 080#0102030405 T
(1700000000.000200) can0 00008001##10A0B R
(1700000000.000300) can0 0C1#R
(1700000000.000400) can0 20000080#0004000000000000
(1700000000.000500) can0 7FF#
"""
PRINTED_LINES = {  # by the candump option that prints such lines
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


def write_log(folder: Path, text: str | bytes, name: str = "bus.log") -> BusLog:
    """Write a log file, and open it."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return BusLog(path)


def test_read_log_of_candump_file_equals_python_can(tmp_path: Path) -> None:
    log = write_log(tmp_path, LOG_LINES)
    with can.LogReader(log.path) as reference_frames:
        for frame, reference_frame in zip(log, reference_frames, strict=True):
            assert frame.equals(
                reference_frame, timestamp_delta=0.0, check_channel=not frame.is_error_frame
            ), (
                frame,
                reference_frame,
            )
    assert list(log.report()) == []
    compressed = write_log(tmp_path, gzip.compress(LOG_LINES.encode()), "bus.log.gz")
    assert len(list(compressed)) == 6
    assert list(compressed.report()) == []


@pytest.mark.parametrize("option", PRINTED_LINES)
def test_read_log_of_printed_candump_lines_keeps_timestamps(tmp_path: Path, option: str) -> None:
    log = write_log(tmp_path, PRINTED_LINES[option])
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
            LOG_LINES + "(1700000000.000600) can0 105#00112233",
            6,
            "line 7: '(1700000000.000600) can0 105#00112233'",
        ),
        (
            LOG_LINES + "(1700000000.000600) can0 105#0011223 ",
            6,
            "line 7: '(1700000000.000600) can0 105#0011223 '",
        ),
        (LOG_LINES + "(17000000", 6, "line 7: '(17000000'"),
        (LOG_LINES + "\0" * 5000, 6, "line 7: '\\x00"),
        (
            PRINTED_LINES[""] + "  can0  105   [8]  00 11 22 3",
            3,
            "line 4: '  can0  105   [8]  00 11 22 3'",
        ),
        (LOG_LINES[:70] + "\0\0\0\n" + LOG_LINES, 7, "line 2: "),
    ],
)
def test_read_log_of_cut_file_names_the_dropped_line(
    tmp_path: Path, cut: str, frames: int, report: str
) -> None:
    log = write_log(tmp_path, cut)
    assert len(list(log)) == frames
    line = next(iter(log.report()))
    assert line.startswith(f"1 line is not a complete frame and was left out: {report}")
    assert len(line) < 200


def test_read_log_last_line_without_newline_is_accepted_with_direction(tmp_path: Path) -> None:
    log = write_log(tmp_path, LOG_LINES.splitlines()[0])
    assert len(list(log)) == 1
    assert list(log.report()) == []


def test_read_log_of_many_dropped_lines_reports_their_count(tmp_path: Path) -> None:
    log = write_log(tmp_path, LOG_LINES + "noise\n" * 10)
    assert len(list(log)) == 6
    assert list(log.report()) == [
        "10 lines are not complete frames and were left out: line 7: 'noise'; line 8: 'noise'; line 9: 'noise'; and 7 more"
    ]


def test_read_log_of_cut_asc_or_gzip_returns_whole_frames(tmp_path: Path) -> None:
    path = tmp_path / "bus.asc"
    with can.LogReader(write_log(tmp_path, LOG_LINES).path) as frames, can.Logger(path) as logger:
        for frame in frames:
            logger(frame)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:-2])[:-20] + b"zz\n")
    log = BusLog(path)
    assert len(list(log)) >= 3
    compressed_path = tmp_path / "bus.log.gz"
    compressed_path.write_bytes(gzip.compress(LOG_LINES.encode() * 1000)[:-300])
    log = BusLog(compressed_path)
    assert len(list(log)) > 100
    assert "1 line is not a complete frame" in next(iter(log.report()))


@pytest.mark.parametrize("text", ["not a frame\n", "\0" * 100, "(nan) can0 105#00\n"])
def test_read_log_of_file_without_frames_is_refused(tmp_path: Path, text: str) -> None:
    with raises_error(ConfigError, code="recording/not-readable"):
        list(write_log(tmp_path, text))
    with raises_error(ConfigError, code="recording/not-readable"):
        list(BusLog(tmp_path / "nothing.log"))

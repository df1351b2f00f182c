"""The log: what was taken and what came, in candump's format, and nothing else."""

import math
import re
from pathlib import Path

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_testing.messages import raises_error

LINE = re.compile(r"\((\d+\.\d{6})\) (\S+) ([0-9A-F]{3})#([0-9A-F]*) ([RT])\n")


class OnFile(VirtualWire):
    """A bus that is waited for by a file."""

    def fileno(self) -> int | None:
        return 42


def test_log_of_sent_and_received_frames_keeps_their_order(tmp_path: Path) -> None:
    path, other = tmp_path / "bus.log", VirtualWire("can3")
    with open_log(path) as log:
        wire, neighbor = (LoggedWire(OnFile(channel), log) for channel in ("can3", "can4"))
        assert wire.channel == "can3"
        assert wire.fileno() == 42
        assert wire.idle() == math.inf
        assert wire.send(CanFrame(0x105, bytes.fromhex("00112233")))
        wire.inject("full", begins=True)
        assert not wire.send(CanFrame(0x106, b"\x01"))
        wire.inject("full", begins=False)
        assert [error.kind for error in wire.errors()] == ["queue_full"]
        for frame in (CanFrame(0x7, b""), CanFrame(0x7FF, bytes(8))):
            other.send(frame)
        assert wire.receive() == [CanFrame(0x7, b""), CanFrame(0x7FF, bytes(8))]
        assert wire.receive() == []
        assert neighbor.send(CanFrame(0, b"\x02"))
        for one in (other, wire, neighbor):
            one.close()
        with raises_error(BackendError, code="bus/io-failed"):
            wire.send(CanFrame(0, b""))
        lines = [LINE.fullmatch(line) for line in path.read_text().splitlines(keepends=True)]
    assert [line and line.groups()[1:] for line in lines] == [
        ("can3", "105", "00112233", "T"),
        ("can3", "007", "", "R"),
        ("can3", "7FF", "0000000000000000", "R"),
        ("can4", "000", "02", "T"),
    ]
    stamps = [float(line[1]) for line in lines if line]
    assert stamps == sorted(stamps)


def test_a_log_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with raises_error(ConfigError, code="file/not-writable"):
        open_log(tmp_path / "nowhere" / "bus.log")

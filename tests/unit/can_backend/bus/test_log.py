"""A bus log holds exactly the frames that were sent and received, in the format of candump."""

import math
import re
from pathlib import Path

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_testing.messages import raises_error

LOG_LINE = re.compile(r"\((\d+\.\d{6})\) (\S+) ([0-9A-F]{3})#([0-9A-F]*) ([RT])\n")

FILE_DESCRIPTOR = 42


class WireWithDescriptor(VirtualWire):
    """A wire with a file descriptor, as that of a real CAN interface."""

    def fileno(self) -> int | None:
        return FILE_DESCRIPTOR


def test_log_of_sent_and_received_frames_keeps_their_order(tmp_path: Path) -> None:
    path = tmp_path / "bus.log"
    far_end = VirtualWire("can3")
    with open_log(path) as log:
        wire = LoggedWire(WireWithDescriptor("can3"), log)
        neighbor = LoggedWire(WireWithDescriptor("can4"), log)
        assert wire.channel == "can3"
        assert wire.fileno() == FILE_DESCRIPTOR
        assert wire.idle() == math.inf
        assert wire.send(CanFrame(0x105, bytes.fromhex("00112233")))
        wire.inject("full", begins=True)
        assert not wire.send(CanFrame(0x106, b"\x01"))
        wire.inject("full", begins=False)
        assert [error.kind for error in wire.errors()] == ["queue_full"]
        for frame in (CanFrame(0x7, b""), CanFrame(0x7FF, bytes(8))):
            far_end.send(frame)
        assert wire.receive() == [CanFrame(0x7, b""), CanFrame(0x7FF, bytes(8))]
        assert wire.receive() == []
        assert neighbor.send(CanFrame(0, b"\x02"))
        for opened in (far_end, wire, neighbor):
            opened.close()
        with raises_error(BackendError, code="bus/io-failed"):
            wire.send(CanFrame(0, b""))
        entries = [LOG_LINE.fullmatch(line) for line in path.read_text().splitlines(keepends=True)]
    assert [entry and entry.groups()[1:] for entry in entries] == [
        ("can3", "105", "00112233", "T"),
        ("can3", "007", "", "R"),
        ("can3", "7FF", "0000000000000000", "R"),
        ("can4", "000", "02", "T"),
    ]
    timestamps = [float(entry[1]) for entry in entries if entry]
    assert timestamps == sorted(timestamps)


def test_log_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with raises_error(ConfigError, code="file/not-writable"):
        open_log(tmp_path / "nowhere" / "bus.log")

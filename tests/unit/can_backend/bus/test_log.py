"""The log: what was taken and what came, in candump's format, and nothing else."""

import io
import re
from pathlib import Path

import pytest
from cantools.logreader import Parser

from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.log import LoggedWire, open_log
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.errors import ConfigError

LINE = re.compile(r"\((\d+\.\d{6})\) (\S+) ([0-9A-F]{3})#([0-9A-F]*) ([RT])\n")


class FakeWire:
    """Takes what it is told to take."""

    def __init__(self, channel: str = "can3") -> None:
        self.channel = channel
        self.takes = True
        self.incoming: list[Frame] = []
        self.closed = False

    def send(self, frame: Frame) -> bool:
        return self.takes

    def receive(self) -> list[Frame]:
        frames, self.incoming = self.incoming, []
        return frames

    def errors(self) -> list[BusError]:
        return [BusError("queue_full", self.channel, "full")]

    def fileno(self) -> int | None:
        return 42

    def idle(self) -> float | None:
        return 0.25

    def inject(self, kind: str, *, begins: bool) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self.closed = True


def test_what_is_taken_and_what_comes_is_logged_in_order() -> None:
    inner, log = FakeWire(), io.StringIO()
    wire = LoggedWire(inner, log)
    assert wire.send(Frame(0x105, bytes.fromhex("00112233")))
    inner.takes = False
    assert not wire.send(Frame(0x106, b"\x01"))
    inner.incoming = [Frame(0x7, b""), Frame(0x7FF, bytes(8))]
    assert wire.receive() == [Frame(0x7, b""), Frame(0x7FF, bytes(8))]
    assert wire.receive() == []
    lines = [LINE.fullmatch(line) for line in log.getvalue().splitlines(keepends=True)]
    assert all(lines)
    assert [(m[2], m[3], m[4], m[5]) for m in lines if m] == [
        ("can3", "105", "00112233", "T"),
        ("can3", "007", "", "R"),
        ("can3", "7FF", "0000000000000000", "R"),
    ]
    stamps = [float(m[1]) for m in lines if m]
    assert stamps == sorted(stamps)


def test_cantools_reads_the_log_back(tmp_path: Path) -> None:
    frames = [Frame(0x0C5, bytes.fromhex("3178EC581BF4")), Frame(0, b"\x02"), Frame(0x105, bytes(range(8)))]
    log = open_log(tmp_path / "bus.log")
    for frame, wire in zip(frames, (LoggedWire(FakeWire(f"vcan{i}"), log) for i in range(3)), strict=True):
        wire.send(frame)
        wire.close()
    read = list(Parser(io.StringIO((tmp_path / "bus.log").read_text())))
    log.close()
    assert [(f.frame_id, f.data, f.channel) for f in read] == [(*f, f"vcan{i}") for i, f in enumerate(frames)]
    assert not any(f.is_extended_frame or f.is_remote_frame for f in read)


def test_everything_else_is_the_wires_own(tmp_path: Path) -> None:
    inner = FakeWire()
    log = open_log(tmp_path / "bus.log")
    wire = LoggedWire(inner, log)
    assert (wire.channel, wire.fileno(), wire.idle()) == ("can3", 42, 0.25)
    assert wire.errors() == inner.errors()
    wire.send(Frame(0x105, b"\x01"))
    wire.close()
    assert inner.closed and (tmp_path / "bus.log").read_text().endswith("105#01 T\n")
    log.close()


def test_a_log_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"backends\.can\.log.*choose another file"):
        open_log(tmp_path / "nowhere" / "bus.log")

"""A bus between processes without a kernel module: frames reach all other ends, and injected faults behave as usual."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from snakesim_can_backend.bus.adapter import is_emulated, open_wire, validate_channels
from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.loopback_wire import LIST_PERIOD_S, LoopbackWire
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.base.errors import BackendError
from snakesim_testing.harness.wait import wait_until

SEND = """
import sys
from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.protocol.definitions import CanFrame
open_wire(sys.argv[1]).send(CanFrame(0x123, b"other process"))
"""


def channel(tmp_path: Path) -> str:
    return f"loopback:{tmp_path / 'bus'}"


def test_frames_reach_every_other_end_in_order(tmp_path: Path):
    first, second, third = (
        open_wire(channel(tmp_path), None, 1_000_000, 5_000_000) for _ in range(3)
    )
    frames = [CanFrame(0x8001, bytes(range(64))), CanFrame(0x101, b"")]
    for frame in frames:
        assert first.send(frame)
    for wire in (second, third):
        assert wait([wire], 1.0)
        assert wire.receive() == frames
    assert first.receive() == []
    for wire in (first, second, third):
        wire.close()
    assert not list((tmp_path / "bus").iterdir())


def test_frames_of_another_process_arrive_and_a_killed_process_is_forgotten(tmp_path: Path):
    wire = open_wire(channel(tmp_path))
    subprocess.run([sys.executable, "-c", SEND, channel(tmp_path)], check=True, timeout=60)
    wait([wire], 1.0)
    assert wire.receive() == [CanFrame(0x123, b"other process")]
    left_behind = tmp_path / "bus" / f"{2**22 - 1}-9"  # a process id that is above the usual range
    left_behind.touch()
    assert not Path("/proc", str(2**22 - 1)).exists()

    def is_forgotten() -> bool:
        wire.send(CanFrame(1, b""))
        return not left_behind.exists()

    wait_until(is_forgotten, "the end of a killed process", 20 * LIST_PERIOD_S)
    wire.close()


def test_cut_end_neither_sends_nor_receives_until_the_end_of_the_fault(tmp_path: Path):
    near, far = open_wire(channel(tmp_path)), open_wire(channel(tmp_path))
    near.inject("cut", begins=True)
    assert not near.send(CanFrame(1, b""))
    far.send(CanFrame(2, b""))
    wait([near], 0.2)
    assert near.receive() == []
    assert [error.kind for error in near.errors()] == ["interface_down"]
    near.inject("cut", begins=False)
    near.send(CanFrame(3, b""))
    wait([far], 1.0)
    assert far.receive() == [CanFrame(3, b"")]
    near.close()
    far.close()


def test_loopback_is_a_bus_of_emulated_drives_and_needs_a_folder(tmp_path: Path):
    assert is_emulated(channel(tmp_path))
    validate_channels([channel(tmp_path)], needs_fd=True)
    blocked = tmp_path / "file"
    blocked.touch()
    with pytest.raises(BackendError, match="cannot be opened"):
        LoopbackWire("loopback:x", os.fspath(blocked / "bus"))

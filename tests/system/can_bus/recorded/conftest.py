"""Every driver of this folder opens recorded wires."""

import pytest

from snakesim_can_backend.driver import modules
from snakesim_testing.can.recording_bus import WIRES, RecordingWire


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    WIRES.clear()
    monkeypatch.setattr(modules, "VirtualWire", RecordingWire)

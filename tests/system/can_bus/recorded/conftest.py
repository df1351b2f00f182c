"""Every driver of this folder opens recorded wires."""

import pytest

from snakesim_can_backend.driver import modules
from snakesim_testing.can.recorded_wire import WIRES, RecordedWire


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    WIRES.clear()
    monkeypatch.setattr(modules, "VirtualWire", RecordedWire)

"""Mistakes of a driver author are reported with what to change."""

from types import SimpleNamespace
from typing import Any

import pytest

from snakesim_drivers.kit.drive_settings import DriveSettings
from snakesim_drivers.kit.drive_type import make_bus_specs_by_port
from snakesim_testing.contract.kit_drives import KitDrives


def refuse_to_open(*_arguments: Any) -> Any:
    raise AssertionError("no bus is opened here")


def test_driver_type_without_any_port_is_told_to_name_one() -> None:
    with pytest.raises(ValueError, match="memory"):
        make_bus_specs_by_port({}, DriveSettings(), [], refuse_to_open)


def test_drives_without_emulator_attribute_are_named_to_the_author() -> None:
    class RenamedDrives:
        line = None

    bus = SimpleNamespace(drives=RenamedDrives())
    backend = SimpleNamespace(_drives=SimpleNamespace(buses=[bus]))
    with pytest.raises(AttributeError, match="RenamedDrives has no attribute `emulator`"):
        KitDrives(backend)

"""Description of modules for the reference firmware, and its dependencies. These tests start no process."""

import re
from typing import Any

import pytest

from snakesim_can_backend.emulator.reference_firmware import (
    describe_modules,
    validate_firmware_settings,
)
from snakesim_can_backend.settings import CanSettings, MountedModule
from snakesim_hal.base.errors import ConfigError
from snakesim_native.libraries import PACKAGE
from snakesim_native.programs import JOINT_MODULE_REPLAY, JOINT_MODULES
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.messages import raises_error

FIRMWARE = PACKAGE / "joint_module" / "firmware"
INCLUDE = re.compile(r"^#include <(.+)>$", re.MULTILINE)


def read_modules(settings: CanSettings | None = None, **dotted: Any) -> dict[str, dict[str, float]]:
    """Return the description of every module, by the name of its joint."""
    modules: dict[str, dict[str, float]] = {}
    for line in describe_modules(make_can_config(**dotted), settings or CanSettings()).splitlines():
        name, *fields = line.split()
        modules[name] = {
            key: float(value) for key, value in zip(fields[::2], fields[1::2], strict=True)
        }
    return modules


def test_firmware_includes_only_two_standard_headers() -> None:
    included = {name for file in FIRMWARE.iterdir() for name in INCLUDE.findall(file.read_text())}
    assert included == {"stdbool.h", "stdint.h"}


def test_firmware_sources_are_part_of_both_programs() -> None:
    sources = set(FIRMWARE.glob("*.c"))
    assert len(sources) > 4
    assert sources <= set(JOINT_MODULES.list_sources())
    assert sources <= set(JOINT_MODULE_REPLAY.list_sources())


def test_module_descriptions_have_nodes_and_distinct_serial_numbers() -> None:
    modules = read_modules()
    assert [values["node"] for values in modules.values()] == [1, 2, 3, 4]
    assert len({values["serial"] for values in modules.values()}) == 4


def test_module_description_with_gear_is_at_its_shaft() -> None:
    direct = read_modules()["joint_2"]
    mounted = {"drive": {"gear": 4.0, "sign": -1, "zero_rad": 0.5}}
    geared = read_modules(robot__drive=mounted["drive"])["joint_2"]
    assert geared["rated_torque_nm"] == pytest.approx(direct["rated_torque_nm"] / 4)
    assert geared["rated_speed_rad_s"] == pytest.approx(direct["rated_speed_rad_s"] * 4)
    assert geared["inertia_kg_m2"] == pytest.approx(direct["inertia_kg_m2"] / 16)
    assert geared["start_rad"] == pytest.approx(0.5 - 4 * direct["start_rad"])
    assert geared["upper_rad"] == pytest.approx(0.5 - 4 * direct["lower_rad"])
    assert geared["lower_rad"] < geared["upper_rad"]


def test_settings_that_the_firmware_does_not_support_are_refused() -> None:
    with raises_error(ConfigError, code="injection/not-supported"):
        validate_firmware_settings(CanSettings(faults=["mute:joint_1@1"]))
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        validate_firmware_settings(CanSettings(mounted={"joint_1": MountedModule(connected=False)}))
    validate_firmware_settings(CanSettings(mounted={"joint_1": MountedModule(sign=-1)}))

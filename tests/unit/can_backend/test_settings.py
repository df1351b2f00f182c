"""The section [backends.can] of a scenario. tests/unit/hal/model/test_files.py tests what holds for every file."""

from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import PARAMETERS, ModuleParameter
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_testing.messages import raises_error


def read_settings(section: dict[str, Any]) -> CanSettings:
    return decode_table(ConfigTable(section, "crawl.toml", {}), CanSettings, "backends.can")


@pytest.mark.parametrize(
    ("section", "place"),
    [
        ({}, "here"),
        ({"channels": ["can0"]}, "none"),
        ({"emulators": "none"}, "none"),
        ({"channels": ["can0"], "emulators": "process"}, "process"),
    ],
)
def test_can_settings_choose_where_emulators_run(section: dict[str, Any], place: str) -> None:
    assert read_settings(section).emulators_run == place


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("bit_rate", 2_000_000),
        ("contact_rate_hz", -1.0),
        ("watchdog_s", 0.5),
        ("pose_listen", "somewhere"),
        ("pose_listen", "host:port"),
    ],
)
def test_can_settings_bad_value_is_named_with_file_and_expectation(key: str, value: Any) -> None:
    with raises_error(
        ConfigError,
        code=("config/invalid-value", "config/out-of-range"),
        field=("crawl.toml", f"backends.can.{key}"),
        value=value,
    ):
        read_settings({key: value})


def test_can_settings_watchdog_has_the_range_of_the_modules() -> None:
    allowed = PARAMETERS[ModuleParameter.WATCHDOG]
    for value in (allowed.low, allowed.high):
        assert read_settings({"watchdog_s": value}).watchdog_s == value

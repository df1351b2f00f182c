"""What a scenario's [backends.can] section may say, beyond what tests/unit/hal/model/test_files.py has of any file."""

from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import PARAMETERS, ModuleParameter
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import Table, decode


def read(section: dict[str, Any]) -> CanSettings:
    return decode(Table(section, "crawl.toml", {}), CanSettings, "backends.can")


@pytest.mark.parametrize(
    ("section", "where"),
    [
        ({}, "here"),
        ({"channels": ["can0"]}, "none"),
        ({"emulators": "none"}, "none"),
        ({"channels": ["can0"], "emulators": "process"}, "process"),
    ],
)
def test_where_twins_run(section: dict[str, Any], where: str) -> None:
    assert read(section).emulators_run == where


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("bit_rate", 2_000_000, "bit/s"),
        ("contact_rate_hz", -1.0, ">= 0"),
        ("watchdog_s", 0.5, "0.1"),
        ("pose_listen", "somewhere", "pose_listen"),
        ("pose_listen", "host:port", "pose_listen"),
    ],
)
def test_a_bad_value_is_named_with_its_file_and_what_is_wanted(key: str, value: Any, wanted: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read({key: value})
    text = str(caught.value)
    assert text.startswith("crawl.toml: ") and f"backends.can.{key}" in text and wanted in text and str(value) in text


def test_the_watchdog_goes_as_far_as_modules_let_it() -> None:
    allowed = PARAMETERS[ModuleParameter.WATCHDOG]
    for value in (allowed.low, allowed.high):
        assert read({"watchdog_s": value}).watchdog_s == value

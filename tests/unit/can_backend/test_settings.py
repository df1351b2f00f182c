"""What a scenario's [backends.can] section may say, and in which words a bad value is refused."""

from typing import Any

import pytest

from snakesim_can_backend.protocol.definitions import PARAMETERS, Parameter
from snakesim_can_backend.settings import CanSettings, MountedModule
from snakesim_hal.errors import ConfigError
from snakesim_hal.model.files import Table, decode

GOOD: dict[str, Any] = {
    "channels": ["can0", "slcan:/dev/ttyACM0"],
    "bit_rate": 500_000,
    "joints_per_channel": [6, 7],
    "twins": "process",
    "plant": "mujoco",
    "plant_settings": {"anything": 1},
    "mounted": {"joint_2": {"sign": -1, "gear": 9.0}},
    "faults": ["mute:joint_3@2"],
    "contact_rate_hz": 50.0,
    "imu_rate_hz": 0.0,
    "watchdog_s": 0.05,
    "bring_up_limit_s": 30.0,
    "pose_listen": "0.0.0.0:5005",
    "log": "bus.log",
}


def read(section: dict[str, Any]) -> CanSettings:
    return decode(Table(section, "crawl.toml", {}), CanSettings, "backends.can")


def test_everything_can_be_set_and_nothing_must() -> None:
    assert set(GOOD) == set(CanSettings.__struct_fields__)
    settings = read(GOOD)
    wanted = {**GOOD, "mounted": {"joint_2": MountedModule(sign=-1, gear=9.0)}}
    assert {name: getattr(settings, name) for name in GOOD} == wanted
    assert read({}) == CanSettings()


@pytest.mark.parametrize(
    ("section", "where"),
    [
        ({}, "here"),
        ({"channels": ["can0"]}, "none"),
        ({"twins": "none"}, "none"),
        ({"channels": ["can0"], "twins": "process"}, "process"),
    ],
)
def test_where_twins_run(section: dict[str, Any], where: str) -> None:
    assert read(section).twins_run == where


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("channels", "can0", "array"),
        ("channels", [""], "length >= 1"),
        ("bit_rate", 2_000_000, "bit/s"),
        ("channels", [f"can{i}" for i in range(9)], "8"),
        ("joints_per_channel", [63], "62"),
        ("joints_per_channel", [6.5], "int"),
        ("twins", "there", "here"),
        ("contact_rate_hz", -1.0, ">= 0"),
        ("imu_rate_hz", "often", "Hz"),
        ("watchdog_s", 0.5, "0.1"),
        ("bring_up_limit_s", 0.0, "s"),
        ("pose_listen", "somewhere", "pose_listen"),
        ("pose_listen", "host:port", "pose_listen"),
        ("log", 3, "str"),
    ],
)
def test_a_bad_value_is_named_with_its_file_and_what_is_wanted(key: str, value: Any, wanted: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read({key: value})
    text = str(caught.value)
    assert text.startswith("crawl.toml: ") and f"backends.can.{key}" in text and wanted in text
    shown = value if not isinstance(value, list) or len(value) > 1 else value[0]
    assert repr(shown) in text or str(shown) in text


def test_a_word_that_is_almost_right_is_guessed() -> None:
    with pytest.raises(ConfigError, match="did you mean `channels`"):
        read({"channel": ["can0"]})


def test_the_watchdog_goes_as_far_as_modules_let_it() -> None:
    allowed = PARAMETERS[Parameter.WATCHDOG]
    for value in (allowed.low, allowed.high):
        assert read({"watchdog_s": value}).watchdog_s == value

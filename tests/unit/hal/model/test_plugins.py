"""Plugins by name and by file, and their settings."""

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.plugins import (
    BACKENDS,
    CONTROLLERS,
    SERVICES,
    decode_plugin_settings,
    list_installed_plugins,
    load_plugin,
    load_plugin_unless_file,
    register_plugin_temporarily,
)
from snakesim_testing.messages import raises_error

WAVE = """\
import msgspec

class Wave:
    class Settings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
        gain: float = 1.0
"""


@pytest.mark.parametrize("group", [BACKENDS, CONTROLLERS, SERVICES])
def test_everything_installed_loads_and_backends_declare_their_settings(group: str) -> None:
    assert list_installed_plugins(group) == sorted(set(list_installed_plugins(group))) != []
    for name in list_installed_plugins(group):
        plugin: Any = load_plugin(group, name)
        assert callable(plugin)
        if group == BACKENDS:
            assert issubclass(vars(plugin)["Settings"], msgspec.Struct), name


def test_plugin_unknown_name_lists_installed_ones_and_how_to_add() -> None:
    with raises_error(
        ConfigError, code="plugin/not-found", field=("wiggle", "snakesim.controllers"), stored=False
    ) as caught:
        load_plugin(CONTROLLERS, "wiggle")
    assert all(name in str(caught.value) for name in list_installed_plugins(CONTROLLERS))


def test_a_class_of_a_file_is_a_plugin(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(WAVE)
    wave = load_plugin(CONTROLLERS, f"{tmp_path}/wave.py:Wave")
    assert wave.__name__ == "Wave"
    assert decode_plugin_settings(wave, {"gain": 2.0}, "a.toml", "c").gain == 2.0


TRAP = """\
from pathlib import Path
Path({mark!r}).write_text("executed")

class Wave:
    class Settings: ...

class Other: ...

def make(): ...
"""
NAMELESS = {"no class": "", "empty class": ":", "unknown class": ":Wove"}


@pytest.mark.parametrize("nameless", NAMELESS)
@pytest.mark.parametrize("find", [load_plugin, load_plugin_unless_file])
def test_a_file_without_its_class_lists_the_classes(
    find: Any, nameless: str, tmp_path: Path
) -> None:
    (tmp_path / "wave.py").write_text(TRAP.format(mark=str(tmp_path / "mark")))
    with raises_error(ConfigError, code="plugin/not-found", field=f"{tmp_path}/wave.py:Wave"):
        find(CONTROLLERS, f"{tmp_path}/wave.py{NAMELESS[nameless]}")
    assert (tmp_path / "mark").exists() == (find is load_plugin and nameless == "unknown class")


def test_looking_at_a_file_runs_none_of_it(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(TRAP.format(mark=str(tmp_path / "mark")))
    for name in ("Wave", "make", "Path"):
        assert load_plugin_unless_file(CONTROLLERS, f"{tmp_path}/wave.py:{name}") is None
    assert not (tmp_path / "mark").exists()
    assert load_plugin_unless_file(CONTROLLERS, "hold") is load_plugin(CONTROLLERS, "hold")


BROKEN = {
    "no such class": (WAVE, "Wove"),
    "not Python": ("class Wave(:\n", "Wave"),
    "import that fails": ("import no_such_module_anywhere\n", "Wave"),
    "name that is not there": ("x = undefined_thing\n", "Wave"),
    "exception of its own": ("x = 1 / 0\n", "Wave"),
    "exit": ("raise SystemExit(0)\n", "Wave"),
    "deep": ("x = " + "(" * 100_000, "Wave"),
    "NUL": ("x = 1\0", "Wave"),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_a_file_that_cannot_be_loaded_is_one_error(broken: str, tmp_path: Path) -> None:
    text, name = BROKEN[broken]
    (tmp_path / "wave.py").write_text(text)
    with raises_error(ConfigError, code=("plugin/not-found", "plugin/not-loadable")):
        load_plugin(CONTROLLERS, f"{tmp_path}/wave.py:{name}")


def test_a_program_may_offer_what_a_name_stands_for() -> None:
    installed_one = load_plugin(CONTROLLERS, "hold")
    with (
        register_plugin_temporarily(CONTROLLERS, "hold", Plugin),
        register_plugin_temporarily(CONTROLLERS, "mine", Plugin),
    ):
        assert load_plugin(CONTROLLERS, "hold") is load_plugin(CONTROLLERS, "mine") is Plugin
    assert load_plugin(CONTROLLERS, "hold") is installed_one
    with raises_error(ConfigError, code="plugin/not-found", field="mine"):
        load_plugin(CONTROLLERS, "mine")


class Plugin:
    class Settings(FileStruct, frozen=True):
        gain: float = 1.0


def test_plugin_settings_are_checked_by_its_struct_naming_the_source() -> None:
    assert decode_plugin_settings(Plugin, {}, "a.toml", "controllers.p").gain == 1.0
    with raises_error(ConfigError, code="config/unknown-key", field="a.toml"):
        decode_plugin_settings(Plugin, {"gian": 1}, "a.toml", "controllers.p")
    origin = {"controllers.p.gain": "--set control.gain=x"}
    with raises_error(ConfigError, code="config/invalid-value", field="--set"):
        decode_plugin_settings(Plugin, {"gain": "x"}, "a.toml", "controllers.p", origin)


def test_a_plugin_without_settings_is_told_to_state_them() -> None:
    for bad in (object(), type("Bare", (), {}), type("Odd", (), {"Settings": dict})):
        with raises_error(ConfigError, code="plugin/not-loadable", field="Settings"):
            decode_plugin_settings(bad, {}, "a.toml", "x")


def test_plugin_name_in_two_packages_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("waves", "gaits"):
        metadata = tmp_path / f"{package}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n"
        )
        (metadata / "entry_points.txt").write_text(
            f"[snakesim.controllers]\nwave = {package}:Wave\n"
        )
    monkeypatch.syspath_prepend(tmp_path)
    with raises_error(ConfigError, code="plugin/ambiguous", field="wave") as raised:
        load_plugin(CONTROLLERS, "wave")
    assert {"waves (waves:Wave)", "gaits (gaits:Wave)"} <= set(
        re.split(": | and |; ", str(raised.value))
    )
    assert load_plugin(CONTROLLERS, "hold").__name__ == "HoldPose"

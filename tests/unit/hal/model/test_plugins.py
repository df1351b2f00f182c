"""Plugins are loaded by name or from a file, and their settings are checked."""

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

WAVE_CODE = """\
import msgspec

class Wave:
    class Settings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
        gain: float = 1.0
"""


@pytest.mark.parametrize("group", [BACKENDS, CONTROLLERS, SERVICES])
def test_plugin_of_every_installed_name_can_be_loaded(group: str) -> None:
    assert list_installed_plugins(group) == sorted(set(list_installed_plugins(group))) != []
    for name in list_installed_plugins(group):
        plugin: Any = load_plugin(group, name)
        assert callable(plugin)
        if group == BACKENDS:
            assert issubclass(vars(plugin)["Settings"], msgspec.Struct), name


def test_plugin_unknown_name_lists_installed_ones_and_how_to_add() -> None:
    with raises_error(
        ConfigError, code="plugin/not-found", field=("wiggle", "snakesim.controllers"), stored=False
    ) as refusal:
        load_plugin(CONTROLLERS, "wiggle")
    assert all(name in str(refusal.value) for name in list_installed_plugins(CONTROLLERS))


def test_plugin_class_in_a_file_can_be_loaded(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(WAVE_CODE)
    wave = load_plugin(CONTROLLERS, f"{tmp_path}/wave.py:Wave")
    assert wave.__name__ == "Wave"
    assert decode_plugin_settings(wave, {"gain": 2.0}, "a.toml", "c").gain == 2.0


CODE_WITH_SIDE_EFFECT = """\
from pathlib import Path
Path({mark!r}).write_text("executed")

class Wave:
    class Settings: ...

class Other: ...

def make(): ...
"""
CLASS_SUFFIXES = {"no class": "", "empty class": ":", "unknown class": ":Wove"}


@pytest.mark.parametrize("case", CLASS_SUFFIXES)
@pytest.mark.parametrize("load", [load_plugin, load_plugin_unless_file])
def test_plugin_file_without_class_is_refused_with_its_classes(
    load: Any, case: str, tmp_path: Path
) -> None:
    (tmp_path / "wave.py").write_text(CODE_WITH_SIDE_EFFECT.format(mark=str(tmp_path / "mark")))
    with raises_error(ConfigError, code="plugin/not-found", field=f"{tmp_path}/wave.py:Wave"):
        load(CONTROLLERS, f"{tmp_path}/wave.py{CLASS_SUFFIXES[case]}")
    assert (tmp_path / "mark").exists() == (load is load_plugin and case == "unknown class")


def test_plugin_file_is_inspected_without_running_it(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(CODE_WITH_SIDE_EFFECT.format(mark=str(tmp_path / "mark")))
    for name in ("Wave", "make", "Path"):
        assert load_plugin_unless_file(CONTROLLERS, f"{tmp_path}/wave.py:{name}") is None
    assert not (tmp_path / "mark").exists()
    assert load_plugin_unless_file(CONTROLLERS, "hold") is load_plugin(CONTROLLERS, "hold")


BROKEN_FILES = {
    "no such class": (WAVE_CODE, "Wove"),
    "not Python": ("class Wave(:\n", "Wave"),
    "import that fails": ("import no_such_module_anywhere\n", "Wave"),
    "name that is not there": ("x = undefined_thing\n", "Wave"),
    "exception of its own": ("x = 1 / 0\n", "Wave"),
    "exit": ("raise SystemExit(0)\n", "Wave"),
    "deep": ("x = " + "(" * 100_000, "Wave"),
    "NUL": ("x = 1\0", "Wave"),
}


@pytest.mark.parametrize("case", BROKEN_FILES)
def test_plugin_file_that_cannot_be_loaded_is_refused(case: str, tmp_path: Path) -> None:
    text, name = BROKEN_FILES[case]
    (tmp_path / "wave.py").write_text(text)
    with raises_error(ConfigError, code=("plugin/not-found", "plugin/not-loadable")):
        load_plugin(CONTROLLERS, f"{tmp_path}/wave.py:{name}")


def test_plugin_registered_temporarily_replaces_an_installed_one() -> None:
    installed = load_plugin(CONTROLLERS, "hold")
    with (
        register_plugin_temporarily(CONTROLLERS, "hold", Plugin),
        register_plugin_temporarily(CONTROLLERS, "mine", Plugin),
    ):
        assert load_plugin(CONTROLLERS, "hold") is load_plugin(CONTROLLERS, "mine") is Plugin
    assert load_plugin(CONTROLLERS, "hold") is installed
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


def test_plugin_class_without_settings_is_refused() -> None:
    for plugin in (object(), type("Bare", (), {}), type("Odd", (), {"Settings": dict})):
        with raises_error(ConfigError, code="plugin/not-loadable", field="Settings"):
            decode_plugin_settings(plugin, {}, "a.toml", "x")


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
    with raises_error(ConfigError, code="plugin/ambiguous", field="wave") as refusal:
        load_plugin(CONTROLLERS, "wave")
    assert {"waves (waves:Wave)", "gaits (gaits:Wave)"} <= set(
        re.split(": | and |; ", str(refusal.value))
    )
    assert load_plugin(CONTROLLERS, "hold").__name__ == "HoldPose"

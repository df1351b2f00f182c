"""The file of a plugin may import modules of its folder, and these replace no other module."""

import subprocess
from pathlib import Path

import pytest

from snakesim_hal.base.process import make_child_environment, make_python_command

PLUGIN_CODE = """
import random
import helpers
import parts.arm

class Wave:
    random = random.__file__
    imported_values = helpers.GAIN, parts.arm.NAME

    def later(self):
        import at_work
        return at_work.__file__
"""
LOAD_PLUGIN_CODE = """
import pathlib, sys
from snakesim_hal.model.plugins import load_plugin
wave = load_plugin("snakesim.controllers", f"{sys.argv[1]}/wave.py:Wave")
assert wave.imported_values == (2, "arm")
assert pathlib.Path(wave().later()).stem == "at_work"
assert not wave.random.startswith(sys.argv[1]), wave.random
try:
    import optional  # as a library imports an optional dependency
except ModuleNotFoundError:
    print("optional is not found")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Provide a folder with a plugin, modules that it imports, and two modules that must never be imported."""
    (tmp_path / "wave.py").write_text(PLUGIN_CODE)
    (tmp_path / "helpers.py").write_text("import constants\nGAIN = constants.GAIN")
    (tmp_path / "constants.py").write_text("GAIN = 2")
    (tmp_path / "at_work.py").write_text("")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "arm.py").write_text("import names\nNAME = names.ARM")
    (tmp_path / "names.py").write_text("ARM = 'arm'")
    for name in ("random", "optional"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(77)")
    return tmp_path


def test_plugin_file_imports_modules_of_its_folder_without_replacing_others(folder: Path) -> None:
    command = make_python_command("-c", LOAD_PLUGIN_CODE, str(folder))
    result = subprocess.run(
        command,
        env=make_child_environment(),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == "optional is not found\n"

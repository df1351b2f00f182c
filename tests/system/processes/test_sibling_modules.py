"""A plugin's file may import its neighbors, and they replace nothing."""

import subprocess
from pathlib import Path

import pytest

from snakesim_hal.base.process import make_child_environment, make_python_command

FILE = """
import random
import helpers
import parts.arm

class Wave:
    random = random.__file__
    helped = helpers.GAIN, parts.arm.NAME

    def later(self):
        import at_work
        return at_work.__file__
"""
LOADS = """
import pathlib, sys
from snakesim_hal.model.plugins import load_plugin
wave = load_plugin("snakesim.controllers", f"{sys.argv[1]}/wave.py:Wave")
assert wave.helped == (2, "arm") and pathlib.Path(wave().later()).stem == "at_work"
assert not wave.random.startswith(sys.argv[1]), wave.random
try:
    import optional  # as a library does with what it can do without
except ModuleNotFoundError:
    print("as it must be")
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "wave.py").write_text(FILE)
    (tmp_path / "helpers.py").write_text("import constants\nGAIN = constants.GAIN")
    (tmp_path / "constants.py").write_text("GAIN = 2")
    (tmp_path / "at_work.py").write_text("")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "arm.py").write_text("import names\nNAME = names.ARM")
    (tmp_path / "names.py").write_text("ARM = 'arm'")
    for name in ("random", "optional"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(77)")
    return tmp_path


def test_plugin_file_imports_neighbors_and_only_what_it_names(folder: Path) -> None:
    command = make_python_command("-c", LOADS, str(folder))
    ended = subprocess.run(
        command,
        env=make_child_environment(),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ended.returncode, ended.stdout) == (0, "as it must be\n"), ended.stderr

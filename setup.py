"""Compiles the C libraries into the wheel. Everything else about the package is in pyproject.toml.

Without a C compiler the wheel has only the sources. SnakeSIM then uses the Python versions, or compiles the sources
when it first needs them.
"""

import os
import shutil
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

sys.path.insert(0, str(Path(__file__).resolve().parent))

from snakesim_native.compile import SHIPPED_FOLDER, compile_all

COMPILED_FOR_WHEEL = "SNAKESIM_COMPILED"  # a folder with libraries that `make wheels` has compiled for another computer


class BuildWithLibraries(build_py):
    """Copies the packages, and compiles the libraries."""

    def run(self) -> None:
        """Build everything. An editable installation compiles its libraries in the repository, when they are needed."""
        super().run()
        if not self.editable_mode:
            self._add_libraries(Path(self.build_lib, "snakesim_native", SHIPPED_FOLDER.name))

    def _add_libraries(self, folder: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        prebuilt = os.environ.get(COMPILED_FOR_WHEEL)
        if prebuilt:
            shutil.copytree(prebuilt, folder)
            return
        for sentence in compile_all(folder):
            print(sentence)


class WheelWithLibraries(bdist_wheel):
    """Makes a wheel for one kind of processor, or for all of them if it has no compiled library."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tags of the wheel's name: any Python 3, no ABI, and the platform."""
        if not list(Path(self.bdist_dir or ".").glob("snakesim_native/compiled/*.so")):
            return super().get_tag()
        self.root_is_pure = False
        *_, platform = super().get_tag()
        return "py3", "none", platform


setup(cmdclass={"build_py": BuildWithLibraries, "bdist_wheel": WheelWithLibraries})

"""Installs SnakeSIM from a wheel or from its sources: into a folder, an environment, or a home folder.

None of these functions needs a network. The packages that SnakeSIM depends on come from the environment that runs the
tests, through links to its files or `PYTHONPATH`.
"""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from snakesim_testing.runs.command import CompletedRun, make_environment, run_program
from snakesim_testing.runs.documents import UV

PROGRAM_TIMEOUT_S = 100.0
INSTALL_ALONE = ("--quiet", "--no-deps", "--no-build-isolation")
PRINT_LIBRARY = "import sysconfig; print(sysconfig.get_path('purelib'))"


@dataclass(frozen=True)
class Installation:
    """An installation of SnakeSIM without the packages that it depends on."""

    command: Path  # of `snakesim`
    library: Path  # folder with the packages
    extra_search_path: Path | None = (
        None  # Python finds the packages only with this entry of PYTHONPATH
    )


def try_program(*command: object, cwd: Path, **variables: str) -> CompletedRun:
    """Run a program without a package index until it ends, and return its exit code and output.

    Args:
        command: The program and its arguments.
        cwd: Folder in which it runs.
        variables: Variables that are added to its environment.
    """
    environment = {**make_environment(cwd), "UV_OFFLINE": "1", **variables}
    return run_program(command, cwd, environment, PROGRAM_TIMEOUT_S)


def run_successful_program(*command: object, cwd: Path, **variables: str) -> str:
    """Run a program as `try_program` does, fail if its exit code is not 0, and return its standard output."""
    completed = try_program(*command, cwd=cwd, **variables)
    assert completed.code == 0, completed.printed
    return completed.out


def create_empty_environment(home: Path) -> tuple[Path, Path]:
    """Create a virtual environment, and return the paths of its Python and of its folder for packages."""
    run_successful_program(UV, "venv", "--python", sys.executable, home / "env", cwd=home)
    python = home / "env" / "bin" / "python"
    library = run_successful_program(python, "-c", PRINT_LIBRARY, cwd=home).strip()
    return python, Path(library)


def install_into_folder(source: Path, home: Path) -> Installation:
    """Install a wheel or sources into a folder below `home`, as `pip install --target` does."""
    library = home / "lib"
    run_successful_program(
        UV,
        "pip",
        "install",
        "--target",
        library,
        *INSTALL_ALONE,
        "--python",
        sys.executable,
        source,
        cwd=home,
    )
    return Installation(library / "bin" / "snakesim", library, extra_search_path=library)


def install_into_environment(source: Path, home: Path) -> Installation:
    """Install a wheel or sources into a new virtual environment below `home`."""
    python, library = create_empty_environment(home)
    run_successful_program(
        UV, "pip", "install", *INSTALL_ALONE, "--python", python, source, cwd=home
    )
    return Installation(python.with_name("snakesim"), library)


def install_into_home(source: Path, home: Path) -> Installation:
    """Install a wheel or sources below `home`, as `pip install --user` does.

    The Python is the one that the environment of the tests was created with. The test is skipped if it has no pip.
    """
    python = Path(getattr(sys, "_base_executable", sys.executable))
    pip_version = subprocess.run(
        [python, "-m", "pip", "--version"], capture_output=True, check=False
    )
    if pip_version.returncode != 0:
        pytest.skip(f"{python} has no pip")
    run_successful_program(
        python,
        "-m",
        "pip",
        "install",
        "--user",
        "--no-deps",
        "--no-index",
        "--no-warn-script-location",
        source,
        cwd=home,
        PYTHONUSERBASE=str(home / "base"),
        PIP_BREAK_SYSTEM_PACKAGES="1",
    )
    library = next((home / "base" / "lib").glob("python*/site-packages"))
    return Installation(home / "base" / "bin" / "snakesim", library)


INSTALLERS: dict[str, Callable[[Path, Path], Installation]] = {
    "target": install_into_folder,
    "environment": install_into_environment,
    "user": install_into_home,
}

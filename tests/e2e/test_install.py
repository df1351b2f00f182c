"""Installed without make: from a wheel or the sources, into an environment, a folder or a person's home.

No network: what SnakeSIM depends on is lent by the environment that runs the tests.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.command import environment, free_endpoint

pytestmark = pytest.mark.e2e

REPOSITORY = Path(__file__).parents[2]
UV = REPOSITORY / ".tools" / "bin" / "uv"
NOT_SOURCES = shutil.ignore_patterns(".*", "runs", "build", "dist", "*.egg-info", "__pycache__")
PACKAGES = ("snakesim_can_backend", "snakesim_gnc", "snakesim_hal", "snakesim_operator", "snakesim_sim_backend")
needs_uv = pytest.mark.skipif(not UV.is_file(), reason="`make setup` has put no uv into .tools")


def run(*command: object, cwd: Path, **more: str) -> str:
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**environment(cwd), "UV_OFFLINE": "1", **more},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, so that the build leaves nothing in the repository. Links stay links, as in a clone."""
    folder = tmp_path_factory.mktemp("sources") / "snakesim"
    shutil.copytree(REPOSITORY, folder, ignore=NOT_SOURCES, symlinks=True)
    return folder


@pytest.fixture(scope="module")
def wheel(sources: Path) -> Path:
    build = (UV, "build", "--wheel", "--no-build-isolation", "--python", sys.executable)
    run(*build, "--out-dir", sources / "dist", ".", cwd=sources)
    return next((sources / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def dependencies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything that is installed here except SnakeSIM."""
    folder = tmp_path_factory.mktemp("dependencies")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "snakesim" not in entry.name:
            (folder / entry.name).symlink_to(entry)
    return folder


Installed = tuple[Path, Path, Path | None]  # the command, the folder with the packages, a folder for PYTHONPATH


def into_a_folder(what: Path, home: Path) -> Installed:
    run(UV, "pip", "install", "--target", home / "lib", *NO_DEPS, what, cwd=home)
    return home / "lib" / "bin" / "snakesim", home / "lib", home / "lib"


def into_an_environment(what: Path, home: Path) -> Installed:
    run(UV, "venv", "--python", sys.executable, home / "env", cwd=home)
    python = home / "env" / "bin" / "python"
    run(UV, "pip", "install", *NO_DEPS[:-2], "--python", python, what, cwd=home)
    library = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=home).strip()
    return home / "env" / "bin" / "snakesim", Path(library), None


def into_a_home(what: Path, home: Path) -> Installed:
    """As `pip install --user` does it; the Python is the one that the environment here was made of."""
    python = Path(getattr(sys, "_base_executable", sys.executable))
    pip = [python, "-m", "pip", "install", "--user", "--no-deps", "--no-index", "--no-warn-script-location"]
    if subprocess.run([python, "-m", "pip", "--version"], capture_output=True, check=False).returncode != 0:
        pytest.skip(f"{python} has no pip")
    run(*pip, what, cwd=home, PYTHONUSERBASE=str(home / "base"), PIP_BREAK_SYSTEM_PACKAGES="1")
    return home / "base" / "bin" / "snakesim", next((home / "base" / "lib").glob("python*/site-packages")), None


NO_DEPS = ("--quiet", "--no-deps", "--no-build-isolation", "--python", sys.executable)
WAYS: dict[str, Callable[[Path, Path], Installed]] = {
    "target": into_a_folder,
    "environment": into_an_environment,
    "user": into_a_home,
}


@needs_uv
@pytest.mark.parametrize("way", [way if way == "user" else pytest.param(way, marks=pytest.mark.slow) for way in WAYS])
def test_a_wheel_has_all_that_it_needs(way: str, wheel: Path, dependencies: Path, tmp_path: Path) -> None:
    check(WAYS[way](wheel, tmp_path), dependencies, tmp_path)


@needs_uv
@pytest.mark.slow
def test_the_sources_installed_as_they_are(sources: Path, dependencies: Path, tmp_path: Path) -> None:
    """`pip install .`; what builds it is lent by the environment here, too."""
    check(into_a_folder(sources, tmp_path), dependencies, tmp_path)


def check(installed: Installed, dependencies: Path, home: Path) -> None:
    command, library, on_path = installed
    path = os.pathsep.join(str(folder) for folder in (on_path, dependencies) if folder is not None)
    more = {"PYTHONPATH": path, "PYTHONUSERBASE": str(home / "base")}
    work = home / "work"
    work.mkdir()

    assert run(command, "--version", cwd=work, **more).startswith("snakesim ")
    assert "planar13" in run(command, "scenarios", cwd=work, **more)
    assert "together" in run(command, "can", "load", "triplet", cwd=work, **more)
    published = [Path(line) for line in run(command, "schemas", cwd=work, **more).splitlines()]
    names = {str(path.relative_to(library / "snakesim_hal" / "schemas")) for path in published}
    wanted = {str(path.relative_to(REPOSITORY / "schemas")) for path in (REPOSITORY / "schemas").rglob("*.*")}
    assert names == wanted and all(path.is_file() for path in published)
    for package in PACKAGES:
        assert (library / package / "py.typed").is_file(), package
    flags = ("--controller", "hold", "--duration", "0.2", "--out", "run", "--endpoint", free_endpoint())
    run(command, "run", "triplet", *flags, cwd=work, **more)
    assert (work / "run" / "report.html").is_file()

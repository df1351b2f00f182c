"""Tests of an installation without make: from a wheel or the sources, into an environment, a folder or a home.

The tests need no network. The packages that SnakeSIM depends on come from the environment that runs the tests.
"""

import os
import sysconfig
import zipfile
from pathlib import Path

import pytest

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.documents import REPOSITORY, needs_uv
from verification.installation.ways_to_install import (
    INSTALLERS,
    Installation,
    install_into_folder,
    run_successful_program,
)

pytestmark = pytest.mark.e2e

SCHEMAS = REPOSITORY / "schemas"
PACKAGES = (
    "snakesim_can_backend",
    "snakesim_gnc",
    "snakesim_hal",
    "snakesim_native",
    "snakesim_operator",
    "snakesim_sim_backend",
)
SHORT_RUN = ("--controller", "hold", "--duration", "0.2", "--out", "run")


@pytest.fixture(scope="module")
def dependencies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with links to all packages that are installed here except SnakeSIM."""
    folder = tmp_path_factory.mktemp("dependencies")
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if "snakesim" not in entry.name:
            (folder / entry.name).symlink_to(entry)
    return folder


@needs_uv
def test_wheel_contains_schemas_type_markers_and_environments(wheel: Path) -> None:
    schemas = {f"snakesim_hal/schemas/{path.relative_to(SCHEMAS)}" for path in SCHEMAS.rglob("*.*")}
    type_markers = {f"{package}/py.typed" for package in PACKAGES}
    expected = {*schemas, *type_markers, "snakesim/environments/__init__.py"}
    missing = expected - {*zipfile.ZipFile(wheel).namelist()}
    assert not missing


@needs_uv
@pytest.mark.slow
@pytest.mark.parametrize("way", INSTALLERS)
def test_installed_wheel_runs_commands(
    way: str, wheel: Path, dependencies: Path, tmp_path: Path
) -> None:
    installation = INSTALLERS[way](wheel, tmp_path)
    check_commands(installation, dependencies, tmp_path)


@needs_uv
@pytest.mark.slow
def test_installed_sources_run_commands(sources: Path, dependencies: Path, tmp_path: Path) -> None:
    """Installs as `pip install .` does, with the build tools of the environment that runs the tests."""
    installation = install_into_folder(sources, tmp_path)
    check_commands(installation, dependencies, tmp_path)


def check_commands(installation: Installation, dependencies: Path, home: Path) -> None:
    """Run commands of an installation, and check that it has all files that they need."""
    search_path = [dependencies]
    if installation.extra_search_path is not None:
        search_path.insert(0, installation.extra_search_path)
    work = home / "work"
    work.mkdir()

    def snakesim(*arguments: str) -> str:
        return run_successful_program(
            installation.command,
            *arguments,
            cwd=work,
            PYTHONPATH=os.pathsep.join(str(folder) for folder in search_path),
            PYTHONUSERBASE=str(home / "base"),
        )

    assert snakesim("--version").startswith("snakesim ")
    assert "planar13" in snakesim("scenario", "list")
    assert "together" in snakesim("drive", "load", "can", "triplet")
    listed_schemas = [Path(line) for line in snakesim("schema").splitlines()]
    installed_schemas = installation.library / "snakesim_hal" / "schemas"
    names = {str(path.relative_to(installed_schemas)) for path in listed_schemas}
    expected_names = {str(path.relative_to(SCHEMAS)) for path in SCHEMAS.rglob("*.*")}
    assert names == expected_names
    assert all(path.is_file() for path in listed_schemas)
    snakesim("run", "triplet", *SHORT_RUN, "--endpoint", find_free_endpoint())
    assert (work / "run" / "report.html").is_file()

"""The sources and the wheel that the tests install, made once."""

import shutil
import sys
from pathlib import Path

import pytest

from snakesim_testing.runs.documents import REPOSITORY, UV, list_excluded_names
from verification.installation.ways_to_install import run_successful_program


@pytest.fixture(scope="session")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the repository, so that a build leaves nothing in it. Links stay links, as in a clone."""
    folder = tmp_path_factory.mktemp("sources") / "snakesim"
    shutil.copytree(REPOSITORY, folder, ignore=list_excluded_names, symlinks=True)
    return folder


@pytest.fixture(scope="session")
def wheel(sources: Path) -> Path:
    """Return the path of a wheel that was built from the sources."""
    run_successful_program(
        UV,
        "build",
        "--wheel",
        "--no-build-isolation",
        "--python",
        sys.executable,
        "--out-dir",
        sources / "dist",
        ".",
        cwd=sources,
    )
    return next((sources / "dist").glob("*.whl"))

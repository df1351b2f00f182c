"""Tests that any feature of `snakesim_operator.features` can be left out, or all: everything else works without it."""

import shutil
import sys
import tomllib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import pytest

from snakesim_hal.programs.commands import Command, Commands
from snakesim_testing.runs.command import CompletedRun, make_environment, run_program
from snakesim_testing.runs.documents import REPOSITORY

pytestmark = pytest.mark.e2e

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
FEATURES = "snakesim_operator.features."
SHORT_RUN = ("run", "triplet", "--in-process", "--set", "duration_s=0.2")
COMMAND_TIMEOUT_S = 100.0
IMPORT_ALL_MODULES = """\
import importlib, pkgutil, snakesim_operator
for module in pkgutil.walk_packages(snakesim_operator.__path__, "snakesim_operator."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print(snakesim_operator.__file__)
"""


def find_commands_by_feature() -> dict[str, list[str]]:
    """Return the names of the commands that each feature registers, such as "robot arm"."""
    names_by_feature: dict[str, list[str]] = {}
    for entry_point in PROJECT["entry-points"]["snakesim.commands"].values():
        if not entry_point.startswith(FEATURES):
            continue
        module, _, attribute = entry_point.partition(":")
        commands: Commands = getattr(import_module(module), attribute)
        feature = module.split(".")[2]
        names_by_feature[feature] = [item.name for item in commands if isinstance(item, Command)]
    return names_by_feature


COMMANDS_BY_FEATURE = find_commands_by_feature()


def copy_packages_without(features: Sequence[str], folder: Path) -> None:
    """Copy all packages except some features, with metadata that replaces that of the installed packages."""
    for package in REPOSITORY.glob("snakesim*"):
        shutil.copytree(
            package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for feature in features:
        shutil.rmtree(folder / "snakesim_operator" / "features" / feature)
    left_out_prefixes = tuple(f"{FEATURES}{feature}." for feature in features)
    lines: list[str] = []
    for group, entry_points in PROJECT["entry-points"].items():
        lines.append(f"[{group}]")
        for name, target in entry_points.items():
            if not target.startswith(left_out_prefixes):
                lines.append(f"{name} = {target}")
    metadata = folder / f"snakesim-{PROJECT['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.4\nName: snakesim\nVersion: {PROJECT['version']}\n"
    )
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    "left_out",
    [
        pytest.param([*COMMANDS_BY_FEATURE], id="all"),
        *(
            pytest.param([feature], id=feature, marks=pytest.mark.slow)
            for feature in COMMANDS_BY_FEATURE
        ),
    ],
)
def test_commands_work_without_left_out_features(left_out: list[str], tmp_path: Path) -> None:
    library = tmp_path / "library"
    work = tmp_path / "work"
    copy_packages_without(left_out, library)
    work.mkdir()

    def run_python(*arguments: str) -> CompletedRun:
        environment = {**make_environment(work), "PYTHONPATH": str(library)}
        return run_program([sys.executable, *arguments], work, environment, COMMAND_TIMEOUT_S)

    def snakesim(*arguments: str) -> CompletedRun:
        return run_python("-m", "snakesim_operator", *arguments)

    imported = run_python("-c", IMPORT_ALL_MODULES)
    assert imported.code == 0, imported.printed
    assert str(library) in imported.out, imported.printed
    overview = snakesim("--help")
    assert overview.code == 0 and not overview.err and " estop " in overview.out, overview.err
    for feature, names in COMMANDS_BY_FEATURE.items():
        first_command = names[0].split()
        answer = snakesim(*first_command, "--help")
        expected_code = 2 if feature in left_out else 0
        assert answer.code == expected_code, answer.printed
    if "console" in left_out:
        answer = snakesim("run", "triplet", "--console")
        assert answer.code == 2 and "without the console" in answer.err, answer.err
    completed = snakesim(*SHORT_RUN)
    assert completed.code == 0, completed.printed

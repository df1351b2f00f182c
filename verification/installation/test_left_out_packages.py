"""Rooms of the operator's tools that nothing imports can be left out, all or one: the rest starts, lists and runs."""

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
COMMANDS: dict[str, list[str]] = {}  # of the rooms that nothing imports, with their nouns
for _name, _at in PROJECT["entry-points"]["snakesim.commands"].items():
    if _at.startswith("snakesim_operator."):
        _module, _, _attribute = _at.partition(":")
        _registered: Commands = getattr(import_module(_module), _attribute)
        COMMANDS[_at.split(".")[2]] = [one.name for one in _registered if isinstance(one, Command)]
IMPORT_ALL = (
    "import importlib, pkgutil, snakesim_operator as top\n"
    "for found in pkgutil.walk_packages(top.__path__, 'snakesim_operator.'):\n"
    "    found.name.endswith('__main__') or importlib.import_module(found.name)\n"
    "print(top.__file__)\n"
)


def without(rooms: Sequence[str], folder: Path) -> Path:
    """A copy of the packages without rooms and their entry points, with metadata that hides the installed ones."""
    for package in REPOSITORY.glob("snakesim*"):
        shutil.copytree(
            package, folder / package.name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for room in rooms:
        shutil.rmtree(folder / "snakesim_operator" / "features" / room)
    gone = tuple(f"snakesim_operator.features.{room}." for room in rooms)
    metadata = folder / f"snakesim-{PROJECT['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.4\nName: snakesim\nVersion: {PROJECT['version']}\n"
    )
    lines: list[str] = []
    for group, entries in PROJECT["entry-points"].items():
        lines.append(f"[{group}]")
        lines += [f"{n} = {at}" for n, at in entries.items() if not at.startswith(gone)]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(
    "rooms",
    [
        pytest.param([*COMMANDS], id="all"),
        *(pytest.param([n], id=n, marks=pytest.mark.slow) for n in COMMANDS),
    ],
)
def test_all_else_works_without(rooms: list[str], tmp_path: Path) -> None:
    library, work = without(rooms, tmp_path / "library"), tmp_path / "work"
    work.mkdir()

    def run(*words: str) -> CompletedRun:
        return run_program(
            [sys.executable, *words],
            work,
            {**make_environment(work), "PYTHONPATH": str(library)},
            100.0,
        )

    imported = run("-c", IMPORT_ALL)
    assert imported.code == 0 and str(library) in imported.out, imported.out + imported.err
    shown = run("-m", "snakesim_operator", "--help")
    assert shown.code == 0 and not shown.err and " estop " in shown.out, shown.err
    for room, names in COMMANDS.items():
        helped = run("-m", "snakesim_operator", *names[0].split(), "--help")
        assert helped.code == (2 if room in rooms else 0), helped.out + helped.err
    if "console" in rooms:
        beside = run("-m", "snakesim_operator", "run", "triplet", "--console")
        assert beside.code == 2 and "without the console" in beside.err, beside.err
    ran = run(
        "-m", "snakesim_operator", "run", "triplet", "--in-process", "--set", "duration_s=0.2"
    )
    assert ran.code == 0, ran.out + ran.err

"""Tests that the commands, imports and files that a page names exist. Other tests run the blocks of tutorials."""

import importlib
import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from docs.style.check_prose import ROOT, list_pages

# A heading of the reference of commands.
COMMAND_HEADING = re.compile(r"^#+ `?snakesim ([a-z][\w -]*?)`?$", re.MULTILINE)
NAMED_COMMAND = re.compile(r"(?:`|^|\$ |bin/)snakesim ([a-z][\w-]*)(?: ([a-z][\w-]*))?")
IMPORT = re.compile(r"^\s*from (snakesim[\w.]*) import ([\w, ]+)", re.MULTILINE)
NAMED_FILE = re.compile(r"`((?:\w[\w-]*/)+[\w.-]+\.(?:py|c|toml|md|sh))(?:::\w+)?`")
FILES = tuple(
    subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
)
WRITTEN_BY_THE_READER = ("acme_servo_driver/", "waves/")


@cache
def list_commands() -> frozenset[str]:
    text = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    return frozenset(COMMAND_HEADING.findall(text))


def find_unknown_commands(text: str) -> Iterator[str]:
    """Yield each command that a text names and that the program does not have."""
    commands = list_commands()
    groups = {command.split()[0] for command in commands if " " in command}
    for line in text.splitlines():
        for verb, second in NAMED_COMMAND.findall(line):
            if verb not in commands or (
                verb in groups and second and f"{verb} {second}" not in commands
            ):
                yield f"snakesim {verb} {second}".rstrip()


def find_unknown_imports(text: str) -> Iterator[str]:
    """Yield each name that a text imports from a package of the project, and that does not exist."""
    for module_name, names in IMPORT.findall(text):
        module = importlib.import_module(module_name)
        for name in re.split(r",\s*", names.strip()):
            if not hasattr(module, name.split(" as ")[0].strip()):
                yield f"{module_name}.{name}"


def find_unknown_files(text: str) -> Iterator[str]:
    """Yield each file of the repository that a text names by its path or the end of it, and that does not exist."""
    for path in NAMED_FILE.findall(text):
        is_known = any(file == path or file.endswith(f"/{path}") for file in FILES)
        if not is_known and not path.startswith(WRITTEN_BY_THE_READER):
            yield path


@pytest.mark.parametrize("page", list_pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_page_names_only_commands_imports_and_files_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert list(find_unknown_commands(text)) == []
    assert list(find_unknown_imports(text)) == []
    assert list(find_unknown_files(text)) == []


def test_unknown_commands_imports_and_files_are_found() -> None:
    text = "run `snakesim router`, `snakesim topic list` or `snakesim topic hear`"
    assert list(find_unknown_commands(text)) == ["snakesim router", "snakesim topic hear"]
    text = "from snakesim_hal.model.scenario import load_scenario, load"
    assert list(find_unknown_imports(text)) == ["snakesim_hal.model.scenario.load"]
    text = "`snakesim_hal/host/host.py`, `host/host.py`, `host/guest.py`"
    assert list(find_unknown_files(text)) == ["host/guest.py"]

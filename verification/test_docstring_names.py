"""Tests that the members of classes and the constants which docstrings name exist, also after a renaming."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
MEMBER = re.compile(r"`(?:\w+\.)*([A-Z]\w+)\.(\w+)(?:\([^`]*\))?`")
CONSTANT = re.compile(r"\b[A-Z][A-Z0-9]*_[A-Z0-9_]*[A-Z]\b")
CODE_SUFFIXES = (".py", ".c", ".h", ".toml", ".dbc", ".js", ".html")
EXTERNAL_CONSTANTS = {
    "CAP_SYS_TIME",
    "MFD_CLOEXEC",
    "PCAN_USBBUS1",
    "PIPE_BUF",
    "XDG_STATE_HOME",
}
PLACEHOLDERS = {"C_N", "C_L", "RUN_A", "RUN_B"}  # in equations and command lines


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    """Return the syntax tree of every shipped file, by its path."""
    paths = sorted(REPOSITORY.glob("snakesim*/**/*.py"))
    return {str(path.relative_to(REPOSITORY)): ast.parse(path.read_text()) for path in paths}


def find_members_by_class(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Return the names that each class defines in its body, its methods, and its base classes in this repository.

    Classes with the same name count as one.
    """
    members: dict[str, set[str]] = defaultdict(set)
    bases: dict[str, set[str]] = defaultdict(set)
    for tree in trees.values():
        for node in ast.walk(tree):
            if not isinstance(node, ast.ClassDef):
                continue
            bases[node.name] |= {
                ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases
            }
            for inner in ast.walk(node):
                match inner:
                    case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.Name(id=name):
                        members[node.name].add(name)
                    case ast.Attribute(attr=name):
                        members[node.name].add(name)
                    case _:
                        pass
    for _ in range(3):  # the deepest class hierarchy has three levels
        for name, parents in bases.items():
            for parent in parents:
                members[name] |= members.get(parent, set())
    return members


def find_docstrings(tree: ast.Module) -> list[str]:
    """Return all docstrings of a file."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, documented)]
    return [text for text in texts if text]


def test_members_that_docstrings_name_exist(trees: dict[str, ast.Module]) -> None:
    members = find_members_by_class(trees)
    checked = 0
    missing: list[str] = []
    for path, tree in trees.items():
        for text in find_docstrings(tree):
            for owner, name in MEMBER.findall(text):
                if owner not in members:
                    continue
                checked += 1
                if name not in members[owner]:
                    missing.append(f"{path}: {owner}.{name}")
    assert checked > 20
    assert not missing


def find_capitalized_names() -> set[str]:
    """Return every capitalized name in code, strings and comments of the product, without docstrings."""
    names: set[str] = set()
    for folder in ("snakesim*", "schemas", "deploy"):
        for path in REPOSITORY.glob(f"{folder}/**/*"):
            if path.suffix not in CODE_SUFFIXES or "vendor" in path.parts:
                continue
            text = path.read_text(encoding="utf-8", errors="replace")
            if path.suffix == ".py":
                text = re.sub(r'""".*?"""', "", text, flags=re.DOTALL)
            names.update(re.findall(r"\b[A-Z]\w+\b", text))
    return names


def test_constants_that_docstrings_name_exist(trees: dict[str, ast.Module]) -> None:
    known = find_capitalized_names() | EXTERNAL_CONSTANTS | PLACEHOLDERS
    named = [
        (path, name)
        for path, tree in trees.items()
        for text in find_docstrings(tree)
        for name in CONSTANT.findall(text)
    ]
    assert len(named) > 50
    assert not [f"{path}: {name}" for path, name in named if name not in known]

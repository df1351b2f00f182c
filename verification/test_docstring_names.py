"""Docstrings that name a member of one of our classes name one that exists, also after a renaming."""

import ast
import re
from collections import defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
MEMBER = re.compile(r"`(?:\w+\.)*([A-Z]\w+)\.(\w+)(?:\([^`]*\))?`")


def shipped_trees() -> dict[str, ast.Module]:
    """Return the syntax tree of every shipped file, by its path."""
    paths = sorted(REPOSITORY.glob("snakesim*/**/*.py"))
    return {str(path.relative_to(REPOSITORY)): ast.parse(path.read_text()) for path in paths}


def members_by_class(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Return what the bodies and methods of all classes of a name define; bases of ours count, too."""
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
    for _ in range(3):  # no hierarchy of ours is deeper
        for name, parents in bases.items():
            for parent in parents:
                members[name] |= members.get(parent, set())
    return members


def docstrings(tree: ast.Module) -> list[str]:
    """Return all docstrings of a file."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = [ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, documented)]
    return [text for text in found if text]


def test_members_that_docstrings_name_exist() -> None:
    trees = shipped_trees()
    members = members_by_class(trees)
    checked = 0
    missing: list[str] = []
    for path, tree in trees.items():
        for text in docstrings(tree):
            for owner, name in MEMBER.findall(text):
                if owner not in members:
                    continue
                checked += 1
                if name not in members[owner]:
                    missing.append(f"{path}: {owner}.{name}")
    assert checked > 20
    assert not missing

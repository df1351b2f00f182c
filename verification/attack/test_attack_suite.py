"""Checks the attacks themselves: they import no code of SnakeSIM, and the pages on attacks name existing tests."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ATTACK_FOLDER = Path(__file__).parent
REPOSITORY = ATTACK_FOLDER.parents[1]
HARNESS_FOLDER = REPOSITORY / "snakesim_testing" / "harness"
LAB_TEST_FOLDER = REPOSITORY / "tests" / "system" / "lab"
CONCEPTS_FOLDER = REPOSITORY / "docs" / "concepts"
CHECKED_FILES = sorted(
    [
        *ATTACK_FOLDER.glob("*.py"),
        *ATTACK_FOLDER.glob("tools/*.py"),
        *HARNESS_FOLDER.glob("*.py"),
    ]
)
ALLOWED_MODULES = (
    "verification.attack",
    "snakesim_testing.harness",
    # Chooses ports that no other test uses, and knows no message or key.
    "snakesim_hal.network.free_ports",
    "zenoh",
    "msgspec.msgpack",
    "psutil",
    "pytest",
    "websockets",
    "zstandard",
)
ROBOT_SIDE = "verification.attack.robot_side"


def is_allowed(module: str) -> bool:
    """Return whether an unauthorized client may import a module or a member of it."""
    if is_inside(module, ROBOT_SIDE):
        return False
    if module.partition(".")[0] in sys.stdlib_module_names:
        return True
    return any(is_inside(module, allowed) for allowed in ALLOWED_MODULES)


def is_inside(module: str, package: str) -> bool:
    """Return whether a dotted name is a package or a part of it."""
    return f"{module}.".startswith(f"{package}.")


def find_imports(path: Path) -> set[str]:
    """Return the dotted names of everything that a file imports."""
    imports: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            imports |= {f"{node.module}.{alias.name}" for alias in node.names}
    return imports


@pytest.mark.parametrize("path", CHECKED_FILES, ids=lambda path: path.name)
def test_attack_files_import_no_code_of_snakesim(path: Path) -> None:
    for module in find_imports(path):
        assert is_allowed(module), f"{path.name} imports {module}"
    if path != Path(__file__):
        code = path.read_text(encoding="utf-8")
        assert "import_module" not in code and "__import__" not in code


def find_named_tests(page: str) -> Iterator[tuple[str, str]]:
    """Yield file and function of each test that a page names; `::test_x` is in the file named before it."""
    text = (CONCEPTS_FOLDER / page).read_text(encoding="utf-8")
    file = ""
    for named_file, function in re.findall(r"`(test_\w+\.py)?::(test_\w+)`", text):
        file = named_file or file
        yield file, function


@pytest.mark.parametrize(("page", "min_tests"), [("open-network.md", 20), ("lab-attackers.md", 10)])
def test_pages_on_attacks_name_existing_tests(page: str, min_tests: int) -> None:
    named_tests = list(find_named_tests(page))
    for file, function in named_tests:
        folders = (ATTACK_FOLDER, LAB_TEST_FOLDER)
        path = next(folder / file for folder in folders if (folder / file).exists())
        code = path.read_text(encoding="utf-8")
        assert f"def {function}(" in code, f"docs/concepts/{page} names {file}::{function}"
    assert len(named_tests) >= min_tests, len(named_tests)

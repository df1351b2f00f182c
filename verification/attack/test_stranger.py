"""The suite and its harness: they know nothing of ours but `schemas/` and the `snakesim` command."""

import ast
import re
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
HARNESS = HERE.parents[1] / "snakesim_testing" / "harness"
LAB = HERE.parents[1] / "tests" / "system" / "lab"
FILES = sorted([*HERE.glob("*.py"), *HERE.glob("means/*.py"), *HARNESS.glob("*.py")])
FREE_PORTS = "snakesim_hal.network.free_ports"  # chooses ports beside other test runs, and knows no message or key
ALLOWED = {FREE_PORTS, "zenoh", "msgspec.msgpack", "psutil", "pytest", "websockets", "zstandard"}


def imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_nothing_of_ours_is_imported(path: Path) -> None:
    for name in imports(path):
        root = name.partition(".")[0]
        ours = name.startswith(("verification.attack.", "snakesim_testing.harness."))
        ours = ours and not name.startswith("verification.attack.data.")
        allowed = any(f"{name}.".startswith(f"{module}.") for module in ALLOWED)
        assert root in sys.stdlib_module_names or allowed or ours, f"{path.name} imports {name}"
    code = path.read_text(encoding="utf-8")
    assert path.name == Path(__file__).name or (
        "import_module" not in code and "__import__" not in code
    )


@pytest.mark.parametrize(("page", "min_tests"), [("open-network.md", 20), ("lab-attackers.md", 10)])
def test_every_test_that_a_page_on_attacks_names_exists(page: str, min_tests: int) -> None:
    text = (HERE.parents[1] / "docs" / "concepts" / page).read_text(encoding="utf-8")
    file, count = "", 0
    for named, test in re.findall(r"`(test_\w+\.py)?::(test_\w+)`", text):
        file = named or file
        path = next(folder / file for folder in (HERE, LAB) if (folder / file).exists())
        assert f"def {test}(" in path.read_text(encoding="utf-8"), (
            f"docs/concepts/{page} names {file}::{test}"
        )
        count += 1
    assert count >= min_tests, count

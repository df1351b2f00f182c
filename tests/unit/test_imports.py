"""Which file imports which, where the import contracts in pyproject.toml do not look."""

import re
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ["snakesim", *sorted(path.name for path in ROOT.glob("snakesim_*"))]


def test_tests_import_no_benchmark() -> None:
    # Most folders of tests are no packages.
    imports = re.compile(r"^\s*(?:from|import) benchmarks\b", re.MULTILINE)
    assert not [path for path in (ROOT / "tests").rglob("*.py") if imports.search(path.read_text())]


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_have_no_cycles_even_inside_functions(package: str) -> None:
    graph = grimp.build_graph(package, cache_dir=None)
    circles = {
        tuple(sorted((one, other)))
        for one in graph.modules
        for other in graph.find_modules_directly_imported_by(one)
        if one in graph.find_modules_directly_imported_by(other)
    }
    assert not circles

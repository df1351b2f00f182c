"""The contract suite itself: what is good passes, and whatever breaks a clause fails that clause."""

import ast
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pytest

from snakesim_testing.benches.driver_mutants import DRIVER_MUTANTS
from snakesim_testing.benches.mutant import Mutant
from snakesim_testing.benches.mutants import MUTANTS
from snakesim_testing.benches.workbench import read_example_from_docs

ROOT = Path(__file__).parents[2]
SUITE = ROOT / "snakesim_testing" / "contract"
PLUGIN = "snakesim_testing.contract.plugin"
pytestmark = pytest.mark.timeout(900)  # whole suites, perhaps on an emulated machine
NOTICED = {"failure", "error"}
BUS = "./snakesim_testing/benches/workbench.py"


def python(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=800, check=False
    )


def run_suite(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run the suite in a process of its own, as a user runs it."""
    plugins = ["-p", "no:cacheprovider", "-p", "snakesim_testing"]
    return python(
        "-m", "pytest", "--pyargs", "snakesim_testing.contract", *plugins, *arguments, cwd=cwd
    )


def clauses() -> set[str]:
    """Names of all contract tests."""
    return {
        node.name
        for path in SUITE.glob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_every_clause_has_a_backend_that_breaks_it() -> None:
    broken = {clause for mutant in MUTANTS for clause in mutant.breaks}
    assert broken == clauses()


def find_unnoticed(mutants: Sequence[Mutant], report: Path) -> list[tuple[str, str, set[str]]]:
    """Run each of these mutants against its clauses, in one process; return what did not fail."""
    names = " or ".join(mutant.name for mutant in mutants)
    ran = run_suite(
        "-p",
        "snakesim_testing.benches.mutants",
        "-k",
        names,
        f"--junitxml={report}",
        "--tb=no",
        "-q",
    )
    assert report.is_file(), ran.stdout + ran.stderr
    # (mutant, clause) -> what came of it.
    outcomes: dict[tuple[str, str], set[str]] = defaultdict(set)
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        clause, _, rest = case.attrib["name"].partition("[")
        children = [child.tag for child in case if child.tag in ("failure", "error", "skipped")]
        outcomes[rest.rstrip("]").partition("-")[0], clause].add(
            children[0] if children else "passed"
        )
    tried = [
        (mutant.name, clause, outcomes[mutant.name, clause])
        for mutant in mutants
        for clause in mutant.breaks
    ]
    return [(name, clause, found) for name, clause, found in tried if not found or found - NOTICED]


def test_a_driver_that_breaks_a_clause_fails_it(tmp_path: Path) -> None:
    assert not find_unnoticed(DRIVER_MUTANTS, tmp_path / "report.xml")


@pytest.mark.slow
def test_a_backend_that_breaks_a_clause_fails_it(tmp_path: Path) -> None:
    """One test, so that workers side by side do not run the suite several times."""
    others = [mutant for mutant in MUTANTS if mutant not in DRIVER_MUTANTS]
    assert not find_unnoticed(others, tmp_path / "report.xml")


@pytest.mark.slow
def test_the_example_of_the_docs_passes_from_anywhere(tmp_path) -> None:
    (tmp_path / "workbench.py").write_text(read_example_from_docs())
    given = [
        "--snakesim-backend",
        "./workbench.py:Workbench",
        "--snakesim-mute",
        "./workbench.py:mute",
    ]
    ran = run_suite(*given, "--snakesim-table", "table.md", "-q", cwd=tmp_path)
    assert ran.returncode == 0, ran.stdout
    assert ran.stdout.count("skipped:") == 3
    assert "joint_1 is described with every mode" in ran.stdout  # so there is none that it lacks
    assert "7 clauses, on Workbench: this bench has no emulated drives" in ran.stdout
    assert "2 clauses, on Workbench: this robot has no power sensor" in ran.stdout
    rows = [
        line
        for line in (tmp_path / "table.md").read_text().splitlines()
        if line.endswith("| pass |")
    ]
    assert len(rows) == len(clauses()) - 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "said"), [("BusWorkbench", ""), ("RealTimeWorkbench", "not exactly repeatable")]
)
def test_contract_passes_late_coarse_slow_or_realtime_backend(backend: str, said: str) -> None:
    looks = ("--snakesim-mute", f"{BUS}:mute", "--snakesim-drives", f"{BUS}:WorkbenchDrives")
    ran = run_suite("--snakesim-backend", f"{BUS}:{backend}", *looks, "-q")
    assert ran.returncode == 0 and said in ran.stdout, ran.stdout


@pytest.mark.parametrize(
    ("given", "said"),
    [
        pytest.param((), "give --snakesim-backend", marks=pytest.mark.slow),
        pytest.param(
            ("--snakesim-backend", "nothing_of_that_name"),
            "no backend called 'nothing_of_that_name' is installed",
            marks=pytest.mark.slow,
        ),
        (
            ("--snakesim-backend", "sim", "--snakesim-set", "robot.limits.torque_nm=-1"),
            "robot.limits.torque_nm",
        ),
    ],
)
def test_a_wrong_call_is_said_once(given, said) -> None:
    ran = run_suite(*given, "-q")
    assert ran.returncode != 0
    assert said in ran.stdout + ran.stderr
    assert " failed" not in ran.stdout


def test_contract_project_may_define_options_of_usual_names(tmp_path: Path) -> None:
    names = ["--backend", "--scenario", "--set", "--mute"]
    (tmp_path / "conftest.py").write_text(
        f"def pytest_addoption(parser):\n    for name in {names}:\n        parser.addoption(name)\n"
    )
    (tmp_path / "test_it.py").write_text(
        "def test_it(pytestconfig):\n    assert pytestconfig.getoption('--backend') == 'x'\n"
    )
    ran = python("-m", "pytest", "-q", "-p", "no:cacheprovider", "--backend", "x", cwd=tmp_path)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_the_plugin_loads_nothing_of_ours_until_it_is_used() -> None:
    code = f"import sys, {PLUGIN}; print([name for name in sys.modules if name.startswith('snakesim_')])"
    assert python("-c", code).stdout.strip() == str(
        ["snakesim_testing", "snakesim_testing.contract", PLUGIN]
    )

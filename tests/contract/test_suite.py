"""The contract suite passes good backends, and each backend that breaks a clause fails that clause."""

import ast
import os
import re
import subprocess
import sys
from collections import Counter, defaultdict
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
# These tests run whole suites, perhaps on an emulated machine.
pytestmark = pytest.mark.timeout(900)
FAILED_OUTCOMES = {"failure", "error"}
WORKBENCH = "./snakesim_testing/benches/workbench.py"


def run_python(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run Python without the pytest options of this session."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=800, check=False
    )


def run_suite(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run the suite in a process of its own, as a user runs it."""
    plugins = ["-p", "no:cacheprovider", "-p", "snakesim_testing"]
    return run_python(
        "-m", "pytest", "--pyargs", "snakesim_testing.contract", *plugins, *arguments, cwd=cwd
    )


def list_clauses() -> set[str]:
    """Return the names of all contract tests."""
    return {
        node.name
        for path in SUITE.glob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_contract_every_clause_has_a_mutant_that_breaks_it() -> None:
    broken = {clause for mutant in MUTANTS for clause in mutant.breaks}
    assert broken == list_clauses()


def find_unnoticed_mutants(
    mutants: Sequence[Mutant], report: Path
) -> list[tuple[str, str, set[str]]]:
    """Run mutants against their clauses in one process.

    Returns:
        Mutant, clause and outcomes, for each clause that did not fail.
    """
    name_filter = " or ".join(mutant.name for mutant in mutants)
    completed = run_suite(
        "-p",
        "snakesim_testing.benches.mutants",
        "-k",
        name_filter,
        f"--junitxml={report}",
        "--tb=no",
        "-q",
    )
    assert report.is_file(), completed.stdout + completed.stderr
    outcomes: dict[tuple[str, str], set[str]] = defaultdict(set)  # by mutant and clause
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        clause, _, rest = case.attrib["name"].partition("[")
        children = [child.tag for child in case if child.tag in ("failure", "error", "skipped")]
        mutant_name = rest.rstrip("]").partition("-")[0]
        outcomes[mutant_name, clause].add(children[0] if children else "passed")
    expected_failures = [
        (mutant.name, clause, outcomes[mutant.name, clause])
        for mutant in mutants
        for clause in mutant.breaks
    ]
    return [
        (name, clause, outcome)
        for name, clause, outcome in expected_failures
        if not outcome or outcome - FAILED_OUTCOMES
    ]


@pytest.mark.heavy
def test_contract_driver_mutants_fail_the_clauses_they_break(tmp_path: Path) -> None:
    assert not find_unnoticed_mutants(DRIVER_MUTANTS, tmp_path / "report.xml")


@pytest.mark.slow
def test_contract_backend_mutants_fail_the_clauses_they_break(tmp_path: Path) -> None:
    """Run all mutants in one test, so that parallel workers do not run the suite several times."""
    backend_mutants = [mutant for mutant in MUTANTS if mutant not in DRIVER_MUTANTS]
    assert not find_unnoticed_mutants(backend_mutants, tmp_path / "report.xml")


@pytest.mark.slow
def test_contract_example_of_the_docs_passes_in_any_folder(tmp_path) -> None:
    (tmp_path / "workbench.py").write_text(read_example_from_docs())
    options = [
        "--snakesim-backend",
        "./workbench.py:Workbench",
        "--snakesim-mute",
        "./workbench.py:mute",
    ]
    completed = run_suite(*options, "--snakesim-table", "table.md", "-q", cwd=tmp_path)
    assert completed.returncode == 0, completed.stdout
    skip_reasons = re.findall(r"^skipped: .*: (.*)", completed.stdout, re.MULTILINE)
    assert skip_reasons == [
        "this robot has no power sensor",
        "joint_1 is described with every mode",
        "this bench has no access to emulated drives; give --snakesim-drives",
    ]
    table = (tmp_path / "table.md").read_text()
    outcomes = Counter(re.findall(r"\| (pass|skip|fail|-) \|$", table, re.MULTILINE))
    assert set(outcomes) == {"pass", "skip"}
    assert outcomes.total() == len(list_clauses())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "expected_output"),
    [("BusWorkbench", ""), ("RealTimeWorkbench", "not exactly repeatable")],
)
def test_contract_passes_late_coarse_slow_or_realtime_backend(
    backend: str, expected_output: str
) -> None:
    options = (
        "--snakesim-mute",
        f"{WORKBENCH}:mute",
        "--snakesim-drives",
        f"{WORKBENCH}:WorkbenchDrives",
    )
    completed = run_suite("--snakesim-backend", f"{WORKBENCH}:{backend}", *options, "-q")
    assert completed.returncode == 0, completed.stdout
    assert expected_output in completed.stdout, completed.stdout


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("options", "expected_output"),
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
def test_contract_suite_with_wrong_options_reports_the_error_once(options, expected_output) -> None:
    completed = run_suite(*options, "-q")
    assert completed.returncode != 0
    assert expected_output in completed.stdout + completed.stderr
    assert " failed" not in completed.stdout


def test_contract_plugin_leaves_usual_option_names_to_the_project(tmp_path: Path) -> None:
    names = ["--backend", "--scenario", "--set", "--mute"]
    (tmp_path / "conftest.py").write_text(
        f"def pytest_addoption(parser):\n    for name in {names}:\n        parser.addoption(name)\n"
    )
    (tmp_path / "test_it.py").write_text(
        "def test_it(pytestconfig):\n    assert pytestconfig.getoption('--backend') == 'x'\n"
    )
    completed = run_python(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "--backend", "x", cwd=tmp_path
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr


def test_contract_plugin_imports_no_other_modules_until_used() -> None:
    code = f"import sys, {PLUGIN}; print([name for name in sys.modules if name.startswith('snakesim_')])"
    assert run_python("-c", code).stdout.strip() == str(
        ["snakesim_testing", "snakesim_testing.contract", PLUGIN]
    )

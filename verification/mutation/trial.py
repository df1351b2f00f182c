"""Runs the unit tests of a file on a mutant of it.

A forked process imports the mutant instead of the real module.
"""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import types
from pathlib import Path
from typing import NoReturn

import pytest

from verification import TESTS_OF_A_CHANGE

ROOT = Path(__file__).resolve().parents[2]
TEST_FOLDER = Path("tests/unit/hal")

# Files that are mutated, and the tests of each. Quick and specific tests come first: they kill most mutants within a
# second.
TESTS_BY_FILE = {
    "limiter.py": (
        "test_limiter.py",
        "test_gate_limits.py",
        "test_authority.py",
        "test_authority_machine.py",
    ),
    "limit_names.py": ("test_limiter.py", "test_gate_limits.py", "test_authority_machine.py"),
    "joint_limits.py": (
        "test_limiter.py",
        "test_gate_limits.py",
        "test_authority.py",
        "test_authority_machine.py",
    ),
    "lease.py": ("test_lease.py", "test_authority.py", "test_authority_machine.py"),
    "lifecycle.py": (
        "test_lifecycle.py",
        "test_arm_session.py",
        "test_authority.py",
        "test_authority_machine.py",
    ),
    "authority.py": ("test_authority.py", "test_isolation.py", "test_authority_machine.py"),
    "fault_log.py": ("test_fault_log.py", "test_authority.py", "test_authority_machine.py"),
    "isolation.py": ("test_isolation.py", "test_authority_machine.py"),
    "plausibility.py": ("test_plausibility.py", "test_isolation.py", "test_authority_machine.py"),
    "stop_ramp.py": ("test_stop_ramp.py", "test_authority.py", "test_authority_machine.py"),
    "derating.py": ("test_derating.py", "test_authority_machine.py"),
    "thermal.py": ("test_thermal.py",),
}

# Exit codes of pytest.
SURVIVED = int(pytest.ExitCode.OK)
KILLED = int(pytest.ExitCode.TESTS_FAILED)
BROKEN_AT_IMPORT = int(pytest.ExitCode.INTERRUPTED)

# Every trial needs these modules, and no mutant changes them.
SHARED_MODULES = (
    "hypothesis",
    "hypothesis.stateful",
    "numpy",
    "pytest_timeout",
    "snakesim_hal.model.scenario",
)


def make_source_path(file: str) -> Path:
    """Return the path of a mutated file, relative to the root of the repository."""
    package = "physics" if file == "thermal.py" else "safety"
    return Path("snakesim_hal", package, file)


def make_module_name(file: str) -> str:
    """Return the dotted name of the module in a mutated file."""
    return ".".join(make_source_path(file).with_suffix("").parts)


class MutantImporter(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from a source text instead of its file."""

    def __init__(self, file: str, source: str) -> None:
        self._module_name = make_module_name(file)
        self._code = compile(source, file, "exec")

    def find_spec(
        self, fullname: str, path: object = None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self._module_name:
            return None
        return importlib.util.spec_from_loader(fullname, self)

    def exec_module(self, module: types.ModuleType) -> None:
        exec(self._code, module.__dict__)


def import_shared_modules() -> None:
    """Import SHARED_MODULES once, so that the forked processes do not import them again.

    Raises:
        SystemExit: One of these modules imports a file that is mutated. Its mutants would have no effect.
    """
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for module_name in SHARED_MODULES:
        importlib.import_module(module_name)
    already_imported = [file for file in TESTS_BY_FILE if make_module_name(file) in sys.modules]
    if already_imported:
        raise SystemExit(
            f"mutation: {already_imported} are imported before any mutant; remove the module that imports them from "
            "SHARED_MODULES"
        )


def run_tests_on_mutant(file: str, source: str, folder: str) -> NoReturn:
    """Run the tests of a file on a mutant of it, and end the process with the exit code of pytest.

    Args:
        file: Mutated file, a key of TESTS_BY_FILE.
        source: Source text of the mutant.
        folder: Temporary folder for the output and the examples of Hypothesis.
    """
    os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = folder
    os.environ["SNAKESIM_HYPOTHESIS"] = "mutants"
    os.environ["SNAKESIM_SEQUENCES"] = "60"
    log = os.open(str(Path(folder) / f"{os.getpid()}.log"), os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.meta_path.insert(0, MutantImporter(file, source))
    tests = [str(next(TEST_FOLDER.rglob(name))) for name in TESTS_BY_FILE[file]]
    options = ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-p", "pytest_timeout"]
    exit_code = pytest.main([*options, *TESTS_OF_A_CHANGE, *tests])
    sys.stdout.flush()
    os._exit(exit_code)

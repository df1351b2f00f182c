"""One trial: a forked process imports a mutant in place of the real module and runs the unit tests on it."""

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TESTS = Path("tests/unit/hal")
# The tests of a file first, quick ones before thorough ones: most mutants die in the first second.
TRIED_BY = {
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
SURVIVED, KILLED = int(pytest.ExitCode.OK), int(pytest.ExitCode.TESTS_FAILED)
BROKEN_AT_IMPORT = int(pytest.ExitCode.INTERRUPTED)


def place_of(file: str) -> Path:
    """Of a file that is tried, in the repository."""
    return Path("snakesim_hal", "physics" if file == "thermal.py" else "safety", file)


def module_of(file: str) -> str:
    """Its module."""
    return ".".join(place_of(file).with_suffix("").parts)


class InPlaceOf(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Serves one module from a source text instead of from its file."""

    def __init__(self, file: str, source: str) -> None:
        self._name = module_of(file)
        self._code = compile(source, file, "exec")

    def find_spec(
        self, fullname: str, path: object = None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Only the one module is ours."""
        return importlib.util.spec_from_loader(fullname, self) if fullname == self._name else None

    def exec_module(self, module: types.ModuleType) -> None:
        """Run the mutant."""
        exec(self._code, module.__dict__)


def warm_up() -> None:
    """Import what every trial needs and no mutant touches, so that the forks have it already."""
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    for name in (
        "hypothesis",
        "hypothesis.stateful",
        "numpy",
        "pytest_timeout",
        "snakesim_hal.model.scenario",
    ):
        importlib.import_module(name)
    early = [file for file in TRIED_BY if module_of(file) in sys.modules]
    if early:
        raise SystemExit(
            f"mutation: {early} are imported before any mutant; import less in warm_up()"
        )


def run(file: str, source: str, folder: str) -> None:
    """Never returns: ends the process with pytest's exit code. Output and what hypothesis keeps go to a temp folder."""
    os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = folder
    os.environ |= {"SNAKESIM_HYPOTHESIS": "mutants", "SNAKESIM_SEQUENCES": "60"}
    log = os.open(str(Path(folder) / f"{os.getpid()}.log"), os.O_WRONLY | os.O_CREAT)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.meta_path.insert(0, InPlaceOf(file, source))
    tests = [str(next(TESTS.rglob(name))) for name in TRIED_BY[file]]
    code = pytest.main(
        ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-p", "pytest_timeout", *tests]
    )
    sys.stdout.flush()
    os._exit(code)

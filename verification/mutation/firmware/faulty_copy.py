"""Runs tests against a faulty firmware.

The package `snakesim_native`, which contains the firmware, is copied into a temporary folder, and the fault is written
into the copy. Python then finds the copy before the real package, in pytest and in every process that a test starts.
"""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from snakesim_native.compile import SHIPPED_FOLDER
from snakesim_native.libraries import PACKAGE
from verification import TESTS_OF_A_CHANGE

ROOT = Path(__file__).resolve().parents[3]
FIRMWARE_FOLDER = Path("joint_module", "firmware")  # in the package
COMPILED_FIRMWARE_PATTERN = "joint_module*"  # names of the compiled programs
TIME_LIMIT_S = 400.0  # of one run of pytest; a fault may let tests wait for a long time
TEST_TIME_LIMIT_S = 60
OUTCOME_PATTERN = re.compile(r"^(?:FAILED|ERROR) \S+::(\w+)", re.MULTILINE)
KILLED_BY_TIME_LIMIT = "(time limit)"  # stands for the name of a test

COMPILE_CODE = """
from snakesim_native.compile import CannotCompileError
from snakesim_native.programs import JOINT_MODULE_REPLAY, JOINT_MODULES, get_program
try:
    print(get_program(JOINT_MODULE_REPLAY))
    print(get_program(JOINT_MODULES))
except CannotCompileError as error:
    raise SystemExit(f"cannot compile: {error}")
"""


class CannotTestError(Exception):
    """A faulty firmware cannot be tested; the text explains why."""


class DoesNotCompileError(Exception):
    """The compiler does not accept a firmware; the text is its first error."""


@dataclass(frozen=True)
class SelectedTests:
    """Tests that run against a faulty firmware.

    Attributes:
        title: What they are, for tables.
        arguments: Arguments of pytest that select them.
    """

    title: str
    arguments: tuple[str, ...]


FIRMWARE_TESTS = SelectedTests("Firmware test", ("tests/system/firmware",))
CONTRACT_CLAUSES = SelectedTests(
    "Contract clause", ("tests/contract/test_contract.py", "-k", "can-firmware")
)
# The quickest tests. They find most faults within two seconds.
QUICK_TESTS = SelectedTests(
    "Quick test",
    (
        "tests/system/firmware/test_promises.py",
        "tests/system/firmware/test_agreement.py",
        "-k",
        "not sanitized",
    ),
)


@contextlib.contextmanager
def copy_firmware(file: str = "", source: str = "") -> Iterator[Path]:
    """Provide a folder with a copy of `snakesim_native`, in which one file of the firmware has another content.

    Args:
        file: Name of the file, such as `states.c`. Empty: the firmware is not changed.
        source: New content of that file.
    """
    with tempfile.TemporaryDirectory(prefix="snakesim-faulty-firmware-") as folder:
        package = Path(folder, PACKAGE.name)
        # Compiled libraries of the same sources are used again, the programs of the firmware are not.
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
        for program in (package / SHIPPED_FOLDER.name).glob(COMPILED_FIRMWARE_PATTERN):
            program.unlink()
        if file:
            (package / FIRMWARE_FOLDER / file).write_text(source, encoding="utf-8")
        yield Path(folder)


def compile_copy(copy: Path) -> None:
    """Compile both programs of a copy.

    Raises:
        DoesNotCompileError: The compiler refuses the firmware.
        CannotTestError: Another package than the copy was compiled.
    """
    completed = subprocess.run(
        [sys.executable, "-P", "-c", COMPILE_CODE],
        env=_make_environment(copy),
        capture_output=True,
        text=True,
        timeout=TIME_LIMIT_S,
        check=False,
    )
    if completed.returncode != 0:
        raise DoesNotCompileError(completed.stderr.strip())
    programs = completed.stdout.splitlines()
    foreign = [program for program in programs if not Path(program).is_relative_to(copy)]
    if foreign:
        raise CannotTestError(f"these programs are not those of the copy in {copy}: {foreign}")


def find_failing_test(copy: Path, tests: SelectedTests) -> str | None:
    """Run tests against a copy until one fails.

    Args:
        copy: Folder of `copy_firmware`.
        tests: The tests.

    Returns:
        Name of the test that failed, or KILLED_BY_TIME_LIMIT; None if all have passed.

    Raises:
        CannotTestError: Pytest ended for another reason than a failing test.
    """
    command = [
        *(sys.executable, "-P", "-m", "pytest", "-x", "-q", "--tb=no", "-rfE"),
        # The root of the repository must not come before the copy.
        *("-o", "pythonpath=", "-p", "no:cacheprovider", "--timeout", str(TEST_TIME_LIMIT_S)),
        *TESTS_OF_A_CHANGE,
        *tests.arguments,
    ]
    exit_code, output = _run_with_time_limit(command, _make_environment(copy))
    if exit_code is None:
        return KILLED_BY_TIME_LIMIT
    if exit_code == pytest.ExitCode.OK:
        return None
    failed = OUTCOME_PATTERN.search(output)
    if exit_code != pytest.ExitCode.TESTS_FAILED or failed is None:
        raise CannotTestError(f"pytest ended with {exit_code}:\n{output}")
    return failed[1]


def _make_environment(copy: Path) -> dict[str, str]:
    """Return the environment in which Python finds the copy first, also in the children of a test."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}
    environment["PYTHONPATH"] = os.pathsep.join((str(copy), str(ROOT)))
    environment["PYTHONSAFEPATH"] = "1"  # otherwise the working folder would come before the copy
    return environment


def _run_with_time_limit(
    command: Sequence[str], environment: dict[str, str]
) -> tuple[int | None, str]:
    """Run a command in a process group of its own. Return its exit code and output; None at the time limit."""
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=TIME_LIMIT_S)
        return process.returncode, output
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # with the emulated modules that a test started
        process.communicate()
        return None, ""

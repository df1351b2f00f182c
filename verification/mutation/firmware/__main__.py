"""Runs the tests of the C firmware on faulty versions of it, and prints which test finds each fault."""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import verification.mutation.firmware
from snakesim_native.compile import NO_COMPILER, list_compilers
from verification.mutation.explained import read_explained
from verification.mutation.firmware.faulty_copy import (
    CONTRACT_CLAUSES,
    FIRMWARE_TESTS,
    QUICK_TESTS,
    DoesNotCompileError,
    SelectedTests,
    compile_copy,
    copy_firmware,
    find_failing_test,
)
from verification.mutation.firmware.planted_faults import (
    PLANTED_FAULTS,
    PlantedFault,
    read_firmware_file,
)
from verification.mutation.firmware.small_changes import SmallChange, generate_small_changes
from verification.mutation.firmware.traffic_check import TrafficCheck

EQUIVALENT_CHANGES = Path(__file__).with_name("equivalent.toml")
FILES = ("states.c", "control.c", "joint_module.c", "parameters.c", "reports.c", "frames.c")
# Columns of the table of planted faults.
SUITES = (FIRMWARE_TESTS, CONTRACT_CLAUSES)
NOT_FOUND = "–"
NOTHING_TESTED = 1
TESTS_FAIL_WITHOUT_FAULT = 2


@dataclass
class SmallChangeResult:
    """What the tests did with each small change."""

    refused: int = 0  # by the compiler
    found_by_traffic: int = 0
    found_by_test: int = 0
    survived: list[SmallChange] = field(default_factory=list[SmallChange])
    equivalent: set[str] = field(default_factory=set[str])  # survivors that have an explanation

    def count_all(self) -> int:
        """Return the number of changes."""
        found = self.found_by_traffic + self.found_by_test
        return self.refused + found + len(self.equivalent) + len(self.survived)


def main() -> int:
    """Run the tests on faulty firmware, and print what finds each fault.

    Returns:
        0 if every fault is found or explained, 1 if not or if there is no compiler, 2 if a test fails without a fault.
    """
    arguments = _parse_arguments()
    if not list_compilers():
        print(f"firmware: nothing was tested, because {NO_COMPILER}")
        return NOTHING_TESTED
    if arguments.small_changes is not None:
        return run_small_changes(arguments.small_changes or FILES)
    names = arguments.faults or [fault.name for fault in PLANTED_FAULTS]
    return run_planted_faults([fault for fault in PLANTED_FAULTS if fault.name in names])


# --- planted faults ---------------------------------------------------------------------------------------------


def run_planted_faults(faults: Sequence[PlantedFault]) -> int:
    """Print a table with the first test of each suite that finds each fault. Return the exit code."""
    if not _pass_without_fault(SUITES):
        return TESTS_FAIL_WITHOUT_FAULT
    titles = [suite.title for suite in SUITES]
    print(f"| Fault | Promise | {' | '.join(titles)} |\n|---|---|{'---|' * len(titles)}")
    survived: list[str] = []
    counts = [0] * len(SUITES)
    for fault in faults:
        failing_tests = find_failing_tests(fault.file, fault.make_source(), SUITES)
        cells = [NOT_FOUND if test is None else describe_test(test) for test in failing_tests]
        print(f"| `{fault.name}` | {fault.promise} | {' | '.join(cells)} |", flush=True)
        counts = [
            count + (test is not None) for count, test in zip(counts, failing_tests, strict=True)
        ]
        if not any(failing_tests):
            survived.append(fault.name)
    found_by = ", ".join(
        f"{count} by a {title.lower()}" for count, title in zip(counts, titles, strict=True)
    )
    found_count = len(faults) - len(survived)
    print(f"\n{len(faults)} planted faults: {found_count} found ({found_by})")
    for name in survived:
        print(f"SURVIVED: {name}")
    return 1 if survived else 0


def find_failing_tests(file: str, source: str, suites: Sequence[SelectedTests]) -> list[str | None]:
    """Return for each suite the first test that fails if a file of the firmware has another content.

    Args:
        file: File of the firmware; empty for no change.
        source: Its content.
        suites: The tests.

    Raises:
        DoesNotCompileError: The compiler refuses the firmware.
    """
    with copy_firmware(file, source) as copy:
        compile_copy(copy)
        return [find_failing_test(copy, suite) for suite in suites]


def describe_test(name: str) -> str:
    """Return the name of a test as a text for a table."""
    return name.removeprefix("test_").replace("_", " ")


def _pass_without_fault(suites: Sequence[SelectedTests]) -> bool:
    """Return whether all tests pass with the unchanged firmware. Print the first one that does not."""
    for suite, test in zip(suites, find_failing_tests("", "", suites), strict=True):
        if test is not None:
            print(f"firmware: {test} fails without a fault ({' '.join(suite.arguments)})")
            return False
    return True


# --- small changes ----------------------------------------------------------------------------------------------


def run_small_changes(files: Sequence[str]) -> int:
    """Print each small change of some files that no test finds. Return the exit code."""
    if not _pass_without_fault((QUICK_TESTS,)):
        return TESTS_FAIL_WITHOUT_FAULT
    explained = read_explained(EQUIVALENT_CHANGES)
    result = SmallChangeResult()
    with tempfile.TemporaryDirectory(prefix="snakesim-faulty-firmware-") as folder:
        traffic_check = TrafficCheck(Path(folder))
        for file in files:
            for change in generate_small_changes(file, read_firmware_file(file)):
                _test_small_change(change, traffic_check, explained, result)
    obsolete = {key for key in explained if key.partition(" ")[0] in files} - result.equivalent
    for key in sorted(obsolete):
        print(f"explained as equivalent, but there is no such survivor any more: {key}")
    print(
        f"{result.count_all()} small changes of {', '.join(files)}: {result.refused} refused by the compiler, "
        f"{result.found_by_traffic} found by random traffic, {result.found_by_test} by another test, "
        f"{len(result.equivalent)} equivalent, {len(result.survived)} survived"
    )
    return 1 if result.survived or obsolete else 0


def _test_small_change(
    change: SmallChange,
    traffic_check: TrafficCheck,
    explained: set[str],
    result: SmallChangeResult,
) -> None:
    """Add the outcome of one small change to a result. Print the change if no test finds it.

    Args:
        change: The change.
        traffic_check: The quickest check, which runs first.
        explained: Keys of the changes that have no effect.
        result: Where the outcome is counted.
    """
    try:
        if traffic_check.finds_difference(change.file, change.source):
            result.found_by_traffic += 1
            return
    except DoesNotCompileError:
        result.refused += 1
        return
    with copy_firmware(change.file, change.source) as copy:
        failing_test = find_failing_test(copy, QUICK_TESTS)
    if failing_test is not None:
        result.found_by_test += 1
    elif change.key in explained:
        result.equivalent.add(change.key)
    else:
        result.survived.append(change)
        print(f"survived: {change}", flush=True)


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.mutation.firmware",
        description=verification.mutation.firmware.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    names = [fault.name for fault in PLANTED_FAULTS]
    parser.add_argument(
        "faults",
        nargs="*",
        metavar="FAULT",
        help=f"planted faults to test: {', '.join(names)} (all)",
    )
    parser.add_argument(
        "--small-changes",
        nargs="*",
        metavar="FILE",
        choices=FILES,
        help=f"test small changes of these files instead: {', '.join(FILES)} (all)",
    )
    arguments = parser.parse_args()
    if unknown := set(arguments.faults) - set(names):
        parser.error(f"no planted fault called {', '.join(sorted(unknown))}")
    return arguments


if __name__ == "__main__":
    sys.exit(main())

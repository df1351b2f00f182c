"""The tool that tests faulty firmware: it finds a fault, passes the unchanged firmware, and lists what it changes."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from snakesim_native.compile import NO_COMPILER, list_compilers
from verification.mutation.explained import read_explained
from verification.mutation.firmware.__main__ import (
    EQUIVALENT_CHANGES,
    FILES,
    describe_test,
    find_failing_tests,
)
from verification.mutation.firmware.faulty_copy import (
    QUICK_TESTS,
    ROOT,
    DoesNotCompileError,
)
from verification.mutation.firmware.planted_faults import (
    PLANTED_FAULTS,
    PlantedFault,
    read_firmware_file,
)
from verification.mutation.firmware.small_changes import generate_small_changes
from verification.mutation.firmware.traffic_check import TrafficCheck

PAGE = ROOT / "docs" / "development" / "firmware-faults.md"
needs_compiler = pytest.mark.skipif(not list_compilers(), reason=NO_COMPILER)


def get_fault(name: str) -> PlantedFault:
    return next(fault for fault in PLANTED_FAULTS if fault.name == name)


@needs_compiler
@pytest.mark.timeout(900)
def test_unchanged_firmware_passes_and_a_planted_fault_is_found() -> None:
    assert find_failing_tests("", "", [QUICK_TESTS]) == [None]
    fault = get_fault("no_watchdog")
    assert find_failing_tests(fault.file, fault.make_source(), [QUICK_TESTS]) == [
        "test_emulator_and_reference_agree_on_random_traffic"
    ]


@needs_compiler
def test_traffic_check_finds_a_fault_and_no_difference_without_one(tmp_path: Path) -> None:
    check = TrafficCheck(tmp_path)
    fault = get_fault("doubled_watchdog")
    assert not check.finds_difference(fault.file, read_firmware_file(fault.file))
    assert check.finds_difference(fault.file, fault.make_source())


@needs_compiler
def test_firmware_that_does_not_compile_is_no_found_fault() -> None:
    with pytest.raises(DoesNotCompileError):
        find_failing_tests("states.c", "int jm_state\n", [QUICK_TESTS])


@needs_compiler
def test_program_that_prints_without_end_is_stopped(tmp_path: Path) -> None:
    source = read_firmware_file("joint_module.c")
    empty_check = "    if (module->outbox_count == 0) {\n        return false;\n    }\n"
    assert empty_check in source
    assert TrafficCheck(tmp_path).finds_difference(
        "joint_module.c", source.replace(empty_check, "")
    )


def test_without_a_compiler_the_command_says_that_nothing_was_tested(tmp_path: Path) -> None:
    if importlib.util.find_spec("ziglang") is not None:
        pytest.skip("ziglang is a compiler that cannot be hidden")
    variables = {name: value for name, value in os.environ.items() if name != "CC"}
    completed = subprocess.run(
        [sys.executable, "-m", "verification.mutation.firmware"],
        cwd=ROOT,
        env={**variables, "PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert completed.stdout == f"firmware: nothing was tested, because {NO_COMPILER}\n"
    assert completed.returncode == 1


@pytest.mark.parametrize("fault", PLANTED_FAULTS, ids=lambda fault: fault.name)
def test_planted_fault_replaces_one_place_of_the_firmware(fault: PlantedFault) -> None:
    assert fault.make_source() != read_firmware_file(fault.file)


def test_planted_fault_of_a_changed_firmware_is_refused() -> None:
    moved = PlantedFault(
        name="moved", promise="", file="states.c", original="no such text", faulty=""
    )
    with pytest.raises(ValueError, match="occurs 0 times in states"):
        moved.make_source()


def test_planted_faults_are_those_of_the_page() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:3] == "| `"]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [(name, promise) for name, promise, *_ in cells] == [
        (f"`{fault.name}`", fault.promise) for fault in PLANTED_FAULTS
    ]


def test_small_changes_leave_out_comments_directives_and_declarations() -> None:
    source = (
        "#include <a.h> /* x < 1 */\n"
        "/* a < b\n   c + d; */\n"
        "static int f(int a)\n"
        "{\n"
        "    int *b;\n"
        "    if (a < 2) { /* always */\n"
        "        g(a);\n"
        "    }\n"
        "    return a + a + 0x0F;\n"
        "}\n"
    )
    changes = [change.description for change in generate_small_changes("a.c", source)]
    assert changes == [
        "< -> <= in `if (a < 2) {`",
        "< -> >= in `if (a < 2) {`",
        "2 -> 3 in `if (a < 2) {`",
        "2 -> 1 in `if (a < 2) {`",
        "condition -> its opposite in `if (a < 2) {`",
        "statement -> (removed) in `g(a);`",
        "+ -> - in `return a + a + 0x0F;`",
        "+ -> - in `return a + a + 0x0F;` (2)",
        "0x0F -> 16 in `return a + a + 0x0F;`",
        "0x0F -> 14 in `return a + a + 0x0F;`",
    ]


def test_small_change_changes_one_line() -> None:
    source = read_firmware_file("control.c")
    for change in generate_small_changes("control.c", source):
        lines = zip(source.split("\n"), change.source.split("\n"), strict=True)
        assert [i + 1 for i, (old, new) in enumerate(lines) if old != new] == [change.line]
        assert change.scope != "file" or change.line < 10


def test_equivalent_changes_exist() -> None:
    keys = {
        change.key
        for file in FILES
        for change in generate_small_changes(file, read_firmware_file(file))
    }
    assert read_explained(EQUIVALENT_CHANGES) - keys == set(), EQUIVALENT_CHANGES


def test_test_is_described_as_a_sentence() -> None:
    assert describe_test("test_a_stop_ends") == "a stop ends"

"""Tests that a scenario and a seed have the same digest on every computer, whatever its processor and its speed.

OpenBLAS and NumPy choose other instructions on other processors. Environment variables of these libraries make them
choose here as they would there.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest
from _pytest.mark.structures import ParameterSet

from snakesim_hal.base import arithmetic
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    CompletedRun,
    make_environment,
    run_program,
)
from verification.golden import DURATION_S, GOLDEN

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[2]

ALL_NUMPY_FEATURES = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
# Environment variables that imitate the processor of a computer.
COMPUTERS: dict[str, dict[str, str]] = {
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "plain NumPy": {"NPY_DISABLE_CPU_FEATURES": ALL_NUMPY_FEATURES},
    "all enabled": {"NPY_ENABLE_CPU_FEATURES": ALL_NUMPY_FEATURES},
}
DIFFERING_PARTS = arithmetic.find_differing_parts(arithmetic.measure_arithmetic())
DIFFERENCE = " and ".join(DIFFERING_PARTS) or "without AVX2 and FMA"
needs_common_arithmetic = pytest.mark.skipif(
    not arithmetic.make_common_arithmetic_env() or bool(DIFFERING_PARTS),
    reason=f"this computer computes other digests: {DIFFERENCE}",
)
# Arguments of pytest that select tests of whole runs.
ONE_PROCESS_TESTS = [
    "tests/system/runs",
    "tests/system/recordings",
    "tests/system/commands",
    "-m",
    "not slow and not e2e",
]
IN_PROCESS_RECORD_TESTS = [
    "tests/system/recordings/test_recordings.py",
    "tests/system/commands/test_compare.py",
]
REAL_TIME_TESTS = [
    "tests/system/runs/test_run.py",
    "tests/system/recordings/test_record.py",
    "-k",
    "not no_slow_computer",
]

# A program of a user. It imports NumPy before SnakeSIM could choose the common arithmetic.
PROGRAM = """
import sys
import numpy
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

result = simulate(load_scenario(sys.argv[1], [parse_set_option(f"duration_s={sys.argv[2]}")]).config)
print(result.summary.command_digest, len(result.record.time_s))
"""


def make_user_environment(computer: Mapping[str, str], folder: Path) -> dict[str, str]:
    """Return the environment of a user on another computer, without the variables that the tests set.

    Args:
        computer: Variables that imitate the computer.
        folder: Folder for state.
    """
    variables = {
        name: value
        for name, value in make_environment(folder).items()
        if name not in arithmetic.make_common_arithmetic_env()
    }
    return {**variables, **computer}


def run_as_user(
    command: Sequence[str], folder: Path, computer: Mapping[str, str] | None = None
) -> CompletedRun:
    """Run a program in a folder as a user of another computer does. None stands for this computer."""
    return run_program(command, folder, make_user_environment(computer or {}, folder))


def run_scenario(
    folder: Path, *arguments: str, computer: Mapping[str, str] | None = None
) -> CompletedRun:
    """Run `snakesim run` for as long as the golden digests cover, and return the result."""
    duration = ("--duration", str(DURATION_S))
    command = [*SNAKESIM_COMMAND, "run", *arguments, *duration, "--no-record", "--out", "run"]
    return run_as_user(command, folder, computer)


def find_digest(completed: CompletedRun) -> str:
    """Return the digest that a run has printed, with the remarks behind it."""
    assert "command digest" in completed.out, completed.printed
    _, _, rest = completed.out.partition("command digest")
    digest, _, _ = rest.partition("\n")
    return digest.strip()


def mark_slow(*names: str) -> list[ParameterSet]:
    """Return test parameters that only the campaign uses."""
    return [pytest.param(name, marks=pytest.mark.slow) for name in names]


@needs_common_arithmetic
@pytest.mark.parametrize("scenario", GOLDEN)
def test_scenario_has_golden_digest(tmp_path: Path, scenario: str) -> None:
    digest = find_digest(run_scenario(tmp_path, scenario, "--in-process"))
    assert digest == GOLDEN[scenario], "after an intended change, run `make golden`"


@needs_common_arithmetic
@pytest.mark.parametrize(
    "computer", ["SkylakeX", "plain NumPy", *mark_slow("Haswell", "Nehalem", "all enabled")]
)
def test_digest_is_equal_on_other_processors(tmp_path: Path, computer: str) -> None:
    completed = run_scenario(tmp_path, "peg_row", "--in-process", computer=COMPUTERS[computer])
    assert find_digest(completed) == GOLDEN["peg_row"]


@needs_common_arithmetic
@pytest.mark.parametrize("computer", ["SkylakeX", *mark_slow("plain NumPy")])
def test_digest_is_equal_in_five_processes(tmp_path: Path, computer: str) -> None:
    def run_triplet() -> CompletedRun:
        endpoint = find_free_endpoint()
        return run_scenario(
            tmp_path, "triplet", "--endpoint", endpoint, computer=COMPUTERS[computer]
        )

    completed = run_triplet()
    # If the computer stops for seconds, the run loses a process and is not complete.
    if " is gone: " in completed.out:
        completed = run_triplet()
    assert find_digest(completed) == GOLDEN["triplet"], completed.printed


@needs_common_arithmetic
# Every processor has the instructions that these need.
@pytest.mark.parametrize("computer", ["Nehalem", *mark_slow("Haswell", "plain NumPy")])
def test_digest_is_equal_after_importing_numpy_first(tmp_path: Path, computer: str) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, "program.py", "peg_row", str(DURATION_S)]
    completed = run_as_user(command, tmp_path, COMPUTERS[computer])
    digest, tick_count = completed.out.split() or pytest.fail(completed.err)
    assert digest.startswith(GOLDEN["peg_row"])
    assert int(tick_count) == 100 * DURATION_S


@needs_common_arithmetic
def test_error_of_program_that_imported_numpy_first_is_raised(tmp_path: Path) -> None:
    wrong_program = PROGRAM.replace(
        '[parse_set_option(f"duration_s={sys.argv[2]}")]',
        '[parse_set_option("clock_mode=realtime")]',
    )
    (tmp_path / "program.py").write_text(wrong_program)
    command = [sys.executable, "program.py", "triplet"]
    completed = run_as_user(command, tmp_path, COMPUTERS["Nehalem"])
    assert completed.code == 1
    assert "errors.ConfigError" in completed.err
    assert "must be 'lockstep'" in completed.err


@needs_common_arithmetic
def test_other_c_library_marks_digest_as_local(tmp_path: Path) -> None:
    """Uses the sine of glibc for processors without FMA, which rounds differently."""
    other_library = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"}
    remark = (
        "its own: NumPy and C library round otherwise than on most computers with NumPy 2.2 to 2.4"
    )
    run_command = [*SNAKESIM_COMMAND, "run", "triplet", "--in-process", "--duration", "0.3"]
    local = run_as_user([*run_command, "--out", "run"], tmp_path, other_library)
    assert local.code == 0, local.printed
    assert find_digest(local).endswith(f", {remark}"), local.printed
    info = run_as_user([*SNAKESIM_COMMAND, "recording", "info", "run"], tmp_path)
    assert remark in info.out
    usual = run_as_user([*run_command, "--out", "usual"], tmp_path)
    assert usual.code == 0
    comparison = run_as_user([*SNAKESIM_COMMAND, "study", "compare", "run", "usual"], tmp_path)
    assert "description.arithmetic.C library" in comparison.out, comparison.printed


def run_tests(
    folder: Path, variables: Mapping[str, str], *selection: str, prefix: Sequence[str] = ()
) -> None:
    """Run tests of this repository as a contributor on another computer does, and check that they pass.

    Args:
        folder: Folder for state.
        variables: Variables that imitate the computer.
        selection: Arguments of pytest that select the tests.
        prefix: Command prefix, such as for a control group.
    """
    pytest_command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    completed = subprocess.run(
        [*prefix, *pytest_command, "--timeout", "900", *selection],
        cwd=ROOT,
        env=make_user_environment(variables, folder),
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stdout[-8000:] + completed.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("computer", ["Nehalem"])  # the tests above compare the digests of all
def test_whole_runs_pass_their_tests_on_other_processor(tmp_path: Path, computer: str) -> None:
    run_tests(
        tmp_path,
        COMPUTERS[computer],
        "tests/system/runs",
        "tests/system/recordings",
        "tests/system/commands",
        "-m",
        "not slow",
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("computer", ["Haswell", "Nehalem", "plain NumPy"])
def test_records_are_equal_after_importing_numpy_first(tmp_path: Path, computer: str) -> None:
    run_tests(tmp_path, {**COMPUTERS[computer], "SNAKESIM_UNPINNED": "1"}, *IN_PROCESS_RECORD_TESTS)


@pytest.fixture
def half_a_core() -> Iterator[Path]:
    """Return the folder of a control group whose processes together get half of one core."""
    root = Path("/sys/fs/cgroup")
    is_version_1 = (root / "cpu").is_dir()
    group = (root / "cpu" if is_version_1 else root) / f"snakesim-{os.getpid()}"
    try:
        group.mkdir()
        if is_version_1:
            period_us = int((group / "cpu.cfs_period_us").read_text())
            (group / "cpu.cfs_quota_us").write_text(str(period_us // 2))
        else:
            (group / "cpu.max").write_text("50000 100000")  # quota and period in us
    except OSError as error:
        pytest.skip(f"needs root, and a control group for processor time: {error}")
    yield group
    group.rmdir()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "selection", [ONE_PROCESS_TESTS, REAL_TIME_TESTS], ids=["one process", "in real time"]
)
def test_runs_pass_their_tests_on_half_a_core(
    tmp_path: Path, half_a_core: Path, selection: list[str]
) -> None:
    join_group = ("sh", "-c", f'echo $$ > {half_a_core}/cgroup.procs; exec "$@"', "sh")
    run_tests(tmp_path, {}, *selection, prefix=join_group)

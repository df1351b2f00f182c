"""One seed, one digest, on any computer: under the code that OpenBLAS and NumPy choose there, and on a slow one.

The choice of another computer is set from outside, by the libraries' own variables.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from snakesim_hal.base import arithmetic
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.runs.command import (
    SNAKESIM_COMMAND,
    CompletedRun,
    make_environment,
    run_program,
)
from verification.golden import GOLDEN, SECONDS

pytestmark = pytest.mark.e2e

PLAIN = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
COMPUTERS: dict[str, dict[str, str]] = {
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "plain NumPy": {"NPY_DISABLE_CPU_FEATURES": PLAIN},
    "all enabled": {"NPY_ENABLE_CPU_FEATURES": PLAIN},
}
OWN = arithmetic.find_differing_parts(arithmetic.measure_arithmetic())
common = pytest.mark.skipif(
    not arithmetic.make_common_arithmetic_env() or bool(OWN),
    reason=f"the digests of this computer are its own: {' and '.join(OWN) or 'without AVX2 and FMA'}",
)
IN_ONE_PROCESS = [
    "tests/system/runs",
    "tests/system/recordings",
    "tests/system/commands",
    "-m",
    "not slow and not e2e",
]
OF_THIS_PROCESS = [
    "tests/system/recordings/test_recordings.py",
    "tests/system/commands/test_compare.py",
]
IN_REAL_TIME = [
    "tests/system/runs/test_run.py",
    "tests/system/recordings/test_record.py",
    "-k",
    "not no_slow_computer",
]

PROGRAM = """
import sys
import numpy
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.run.in_process import simulate

result = simulate(load_scenario(sys.argv[1], [parse_set_option(f"duration_s={sys.argv[2]}")]).config)
print(result.summary.command_digest, len(result.record.time_s))
"""


def on(computer: Mapping[str, str], folder: Path) -> dict[str, str]:
    """The environment of a user there, who has heard nothing of ours."""
    ours = make_environment(folder)
    return {
        name: value
        for name, value in ours.items()
        if name not in arithmetic.make_common_arithmetic_env()
    } | dict(computer)


def run(folder: Path, *arguments: str, computer: Mapping[str, str] | None = None) -> CompletedRun:
    typed = [
        *SNAKESIM_COMMAND,
        "run",
        *arguments,
        "--duration",
        str(SECONDS),
        "--no-record",
        "--out",
        "run",
    ]
    return run_program(typed, folder, on(computer or {}, folder))


def digest_in(ended: CompletedRun) -> str:
    assert "command digest" in ended.out, ended.out + ended.err
    return ended.out.partition("command digest")[2].partition("\n")[0].strip()


@common
@pytest.mark.parametrize("scenario", GOLDEN)
def test_a_scenario_has_its_digest(tmp_path: Path, scenario: str) -> None:
    said = "`make golden` writes the digests again, after a change that is meant to change what robots do"
    assert digest_in(run(tmp_path, scenario, "--in-process")) == GOLDEN[scenario], said


@common
@pytest.mark.parametrize(
    "computer",
    [
        "SkylakeX",
        "plain NumPy",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("Haswell", "Nehalem", "all enabled")),
    ],
)
def test_it_is_that_of_every_computer(tmp_path: Path, computer: str) -> None:
    assert (
        digest_in(run(tmp_path, "peg_row", "--in-process", computer=COMPUTERS[computer]))
        == GOLDEN["peg_row"]
    )


@common
@pytest.mark.parametrize(
    "computer", ["SkylakeX", pytest.param("plain NumPy", marks=pytest.mark.slow)]
)
def test_and_that_of_five_processes(tmp_path: Path, computer: str) -> None:
    ended = run(
        tmp_path, "triplet", "--endpoint", find_free_endpoint(), computer=COMPUTERS[computer]
    )
    # A computer that stands for seconds loses a process, and the run is no whole one.
    if " is gone: " in ended.out:
        ended = run(
            tmp_path, "triplet", "--endpoint", find_free_endpoint(), computer=COMPUTERS[computer]
        )
    assert digest_in(ended) == GOLDEN["triplet"], ended.out + ended.err


@common
# No processor lacks what these need.
@pytest.mark.parametrize(
    "computer",
    ["Nehalem", *(pytest.param(n, marks=pytest.mark.slow) for n in ("Haswell", "plain NumPy"))],
)
def test_and_that_of_a_program_that_imported_numpy_first(tmp_path: Path, computer: str) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    typed = [sys.executable, "program.py", "peg_row", str(SECONDS)]
    ended = run_program(typed, tmp_path, on(COMPUTERS[computer], tmp_path))
    digest, ticks = ended.out.split() or pytest.fail(ended.err)
    assert digest.startswith(GOLDEN["peg_row"]) and int(ticks) == 100 * SECONDS


@common
def test_what_such_a_program_did_wrong_is_raised_there(tmp_path: Path) -> None:
    wrong = PROGRAM.replace(
        '[parse_set_option(f"duration_s={sys.argv[2]}")]',
        '[parse_set_option("clock_mode=realtime")]',
    )
    (tmp_path / "program.py").write_text(wrong)
    ended = run_program(
        [sys.executable, "program.py", "triplet"], tmp_path, on(COMPUTERS["Nehalem"], tmp_path)
    )
    assert (
        ended.code == 1 and "errors.ConfigError" in ended.err and "must be 'lockstep'" in ended.err
    )


@common
def test_other_c_library_marks_digest_as_local(tmp_path: Path) -> None:
    """glibc has sines for processors with FMA, and others."""
    other = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4"}
    typed = [
        *SNAKESIM_COMMAND,
        "run",
        "triplet",
        "--in-process",
        "--duration",
        "0.3",
        "--out",
        "run",
    ]
    ended = run_program(typed, tmp_path, on(other, tmp_path))
    own = (
        "its own: NumPy and C library round otherwise than on most computers with NumPy 2.2 to 2.4"
    )
    assert ended.code == 0 and digest_in(ended).endswith(f", {own}"), ended.out + ended.err
    told = run_program([*SNAKESIM_COMMAND, "recording", "info", "run"], tmp_path, on({}, tmp_path))
    assert own in told.out
    assert run_program([*typed[:-1], "usual"], tmp_path, on({}, tmp_path)).code == 0
    compared = run_program(
        [*SNAKESIM_COMMAND, "study", "compare", "run", "usual"], tmp_path, on({}, tmp_path)
    )
    assert "description.arithmetic.C library" in compared.out, compared.out + compared.err


# --- the tests of whole runs, on other computers -------------------------------------------------------------------


def suite(folder: Path, env: Mapping[str, str], *chosen: str, before: tuple[str, ...] = ()) -> None:
    """Run tests as a contributor there does, from this repository."""
    typed = [
        *before,
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "--timeout",
        "900",
        *chosen,
    ]
    root = Path(__file__).parents[2]
    done = subprocess.run(
        typed, cwd=root, env=on(env, folder), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("computer", ["Nehalem"])  # the digests of all are compared above
def test_whole_runs_are_what_they_are_on_every_computer(tmp_path: Path, computer: str) -> None:
    suite(
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
    suite(tmp_path, {**COMPUTERS[computer], "SNAKESIM_UNPINNED": "1"}, *OF_THIS_PROCESS)


@pytest.fixture
def half_a_core() -> Iterator[Path]:
    """A control group whose processes get half of one core, together."""
    v1, v2 = Path("/sys/fs/cgroup/cpu"), Path("/sys/fs/cgroup")
    group = (v1 if v1.is_dir() else v2) / f"snakesim-{os.getpid()}"
    try:
        group.mkdir()
        if v1.is_dir():
            (group / "cpu.cfs_quota_us").write_text(
                str(int((group / "cpu.cfs_period_us").read_text()) // 2)
            )
        else:
            (group / "cpu.max").write_text("50000 100000")
    except OSError as error:
        pytest.skip(f"needs root, and a control group for processor time: {error}")
    yield group
    group.rmdir()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "chosen", [IN_ONE_PROCESS, IN_REAL_TIME], ids=["one process", "in real time"]
)
def test_half_a_core_is_enough(tmp_path: Path, half_a_core: Path, chosen: list[str]) -> None:
    joining = ("sh", "-c", f'echo $$ > {half_a_core}/cgroup.procs; exec "$@"', "sh")
    suite(tmp_path, {}, *chosen, before=joining)

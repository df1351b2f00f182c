"""`python -m verification.soak --minutes 30 [--seed 1] [--backend can]`: a run with one random fault after the other.

After each fault, an operator resets and arms the robot. Prints a table of the faults, and every violation: a stop
without an explanation, a robot that does not recover, a setpoint that jumps, a process that grows or is left over. The
exit code is 1 if there is a violation, and 0 otherwise.
"""

import argparse
import tempfile
import time
from pathlib import Path

from snakesim_testing.harness.processes import find_processes_of_run
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import RunningCommand
from verification.fuzz.network import start_run_and_join
from verification.fuzz.vitals import find_error_lines
from verification.soak.faults import EventDrawer
from verification.soak.health import ProcessHealth
from verification.soak.result import SoakResult, format_result
from verification.soak.soak_operator import SoakOperator
from verification.soak.watch import JudgingObserver

ROBOT = "planar13"
RUN_ARGUMENTS = ("triplet", "--clock-mode", "realtime", "--duration", "86400", "--stay")
MAX_START_S = 120.0
MAX_END_S = 10.0  # until all processes have ended
INTERRUPTED_EXIT_CODE = 130
# The faults of a soak cause reported errors. Errors with these texts are violations nevertheless.
FORBIDDEN_LOG_TEXTS = ("Traceback", "panicked", "Exception")


def soak(out: Path, minutes: float, seed: int, backend: str) -> SoakResult:
    """Start a run, inject random faults, end the run, and check what is left of it.

    Args:
        out: The folder of the run, which must not exist. The log of events is written beside it.
        minutes: How long faults are injected.
        seed: Selects the faults.
        backend: The backend of the run: sim or can.
    """
    result = SoakResult(seed)
    start_s = time.monotonic()
    options = ("--backend", backend, "--seed", str(seed))
    with (
        start_run_and_join(out, ROBOT, *RUN_ARGUMENTS, *options) as (run, session),
        out.with_suffix(".jsonl").open("wb") as log,
    ):
        watch = JudgingObserver(session)
        health = ProcessHealth(out)
        watch.wait_until(lambda: watch.get_lifecycle() == "armed", "armed", MAX_START_S)
        drawer = EventDrawer(seed, joint_count=len(watch.get_description().joints))
        SoakOperator(watch, health, result, log).run(drawer, 60 * minutes)
        result.violations += _end_run(run)
        result.violations += health.find_violations()
        result.health_lines = health.format_summary()
        result.watch_counts = watch.counts
    result.violations += _find_remains(out)
    result.duration_s = time.monotonic() - start_s
    return result


def _end_run(run: RunningCommand) -> list[str]:
    """Interrupt the run, and return what is wrong with its end."""
    violations: list[str] = []
    if run.process.poll() is not None:
        violations.append(f"the run has ended by itself: {run.printed()[-500:]}")
    exit_code = run.interrupt()
    if exit_code != INTERRUPTED_EXIT_CODE:
        violations.append(
            f"an interrupted run ends with exit code {exit_code}, not {INTERRUPTED_EXIT_CODE}"
        )
    return violations


def _find_remains(out: Path) -> list[str]:
    """Find processes that a run has left over, and errors in its logs."""
    violations: list[str] = []
    try:
        wait_until(lambda: not find_processes_of_run(out), "all processes gone", MAX_END_S)
    except AssertionError:
        violations += [
            f"left behind: {pid} {line[:200]!r}" for pid, line in find_processes_of_run(out)
        ]
    violations += [
        f"in a log: {line}"
        for line in find_error_lines(out)
        if any(text in line for text in FORBIDDEN_LOG_TEXTS)
    ]
    return violations


def main() -> int:
    """Parse the options, run the soak, print the result, and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m verification.soak",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="sim", help="backend of the robot: sim or can")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder of the run; the events are written beside it (default: a temporary folder)",
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="snakesim-soak-") as temporary:
        out = (options.out or Path(temporary) / "run").resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        result = soak(out, options.minutes, options.seed, options.backend)
    print(format_result(result))
    return 1 if result.violations else 0


if __name__ == "__main__":
    raise SystemExit(main())

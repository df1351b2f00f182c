"""Runs the unit tests of the safety core on every mutant, and prints the mutants that survive."""

import argparse
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import verification.mutation
from verification.mutation import trial
from verification.mutation.explained import read_explained
from verification.mutation.mutants import SourceMutant, generate_mutants

EQUIVALENT_MUTANTS = Path(__file__).with_name("equivalent.toml")
FORK = multiprocessing.get_context("fork")
POLL_PERIOD_S = 1.0  # in which a trial can exceed its time limit
KILLED_BY_TIME_LIMIT = -signal.SIGKILL  # exit code of a process that this tool killed
EXPECTED_EXIT_CODES = (
    trial.SURVIVED,
    trial.KILLED,
    trial.BROKEN_AT_IMPORT,
    KILLED_BY_TIME_LIMIT,
)


@dataclass
class MutationResult:
    """What the tests did with each mutant."""

    killed: int = 0
    killed_by_time_limit: int = 0  # also counted in `killed`
    survived: list[SourceMutant] = field(default_factory=list[SourceMutant])
    equivalent: set[str] = field(default_factory=set[str])  # survivors that have an explanation


@dataclass(frozen=True)
class RunningTrial:
    """A process that runs the tests on a mutant."""

    mutant: SourceMutant
    process: BaseProcess
    deadline_s: float  # by the monotonic clock

    def is_over(self) -> bool:
        """Return whether the process has ended or has used up its time."""
        return not self.process.is_alive() or time.monotonic() >= self.deadline_s


def main() -> int:
    """Run the tests on every mutant, and print the survivors.

    Returns:
        0 if every mutant is killed or explained, 1 if not, 2 if a test fails without a mutation.
    """
    arguments = _parse_arguments()
    os.chdir(trial.ROOT)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    trial.import_shared_modules()
    start_s = time.monotonic()
    sources = {
        file: (trial.ROOT / trial.make_source_path(file)).read_text() for file in arguments.files
    }
    if not _check_original_sources(sources, arguments.workers, arguments.time_limit):
        return 2

    explained = read_explained(EQUIVALENT_MUTANTS)
    result = _run_mutants(sources, explained, arguments.workers, arguments.time_limit)
    obsolete = {text for text in explained if text.partition(" ")[0] in sources} - result.equivalent
    for text in sorted(obsolete):
        print(f"explained as equivalent, but there is no such survivor any more: {text}")
    mutant_count = result.killed + len(result.equivalent) + len(result.survived)
    print(
        f"{mutant_count} mutants: {result.killed} killed ({result.killed_by_time_limit} by the time limit), "
        f"{len(result.equivalent)} equivalent, {len(result.survived)} survived; {time.monotonic() - start_s:.0f} s"
    )
    return 1 if result.survived or obsolete else 0


def run_trials(
    mutants: Iterator[SourceMutant], worker_count: int, time_limit_s: float
) -> Iterator[tuple[SourceMutant, int]]:
    """Run the tests on mutants, several at a time.

    Args:
        mutants: Mutants to test.
        worker_count: Number of processes that run at the same time.
        time_limit_s: A process that takes longer is killed.

    Yields:
        Each mutant with the exit code of its process, as soon as the process has ended.

    Raises:
        SystemExit: Pytest failed for another reason than a failing test.
    """
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        running: list[RunningTrial] = []
        while True:
            while len(running) < worker_count and (mutant := next(mutants, None)) is not None:
                running.append(_start_trial(mutant, folder, time_limit_s))
            if not running:
                return
            wait([entry.process.sentinel for entry in running], timeout=POLL_PERIOD_S)
            for finished in [entry for entry in running if entry.is_over()]:
                running.remove(finished)
                yield finished.mutant, _end_trial(finished, folder)


def _start_trial(mutant: SourceMutant, folder: str, time_limit_s: float) -> RunningTrial:
    process = FORK.Process(
        target=trial.run_tests_on_mutant, args=(mutant.file, mutant.source, folder)
    )
    process.start()
    return RunningTrial(mutant, process, time.monotonic() + time_limit_s)


def _end_trial(finished: RunningTrial, folder: str) -> int:
    """Kill a process if it is still running, delete its output, and return its exit code."""
    process = finished.process
    process.kill()  # no effect if the process has ended
    process.join()
    (Path(folder) / f"{process.pid}.log").unlink(missing_ok=True)
    exit_code = process.exitcode
    if exit_code not in EXPECTED_EXIT_CODES:
        raise SystemExit(f"mutation: pytest ended with {exit_code} on {finished.mutant}")
    return exit_code


def _check_original_sources(
    sources: Mapping[str, str], worker_count: int, time_limit_s: float
) -> bool:
    """Return whether all tests pass without a mutation. Print the first file for which they fail."""
    originals = [
        SourceMutant(file, "module", 0, "unchanged", source) for file, source in sources.items()
    ]
    for original, exit_code in run_trials(iter(originals), worker_count, time_limit_s):
        if exit_code != trial.SURVIVED:
            print(
                f"mutation: the tests of {original.file} fail without a mutation (exit code {exit_code})"
            )
            return False
    return True


def _run_mutants(
    sources: Mapping[str, str], explained: set[str], worker_count: int, time_limit_s: float
) -> MutationResult:
    """Run the tests on every mutant of the sources. Print each survivor that has no explanation."""
    mutants = (
        mutant for file, source in sources.items() for mutant in generate_mutants(file, source)
    )
    result = MutationResult()
    for mutant, exit_code in run_trials(mutants, worker_count, time_limit_s):
        text = f"{mutant.file} in {mutant.scope}: {mutant.change}"
        if exit_code != trial.SURVIVED:
            result.killed += 1
            result.killed_by_time_limit += exit_code == KILLED_BY_TIME_LIMIT
        elif text in explained:
            result.equivalent.add(text)
        else:
            result.survived.append(mutant)
            print(f"survived: {mutant}", flush=True)
    return result


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.mutation",
        description=verification.mutation.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    files = list(trial.TESTS_BY_FILE)
    parser.add_argument(
        "--files", nargs="+", choices=files, default=files, help="files to mutate (default: all)"
    )
    parser.add_argument(
        "--workers", type=int, default=2, help="processes that run at the same time (default: 2)"
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        default=120.0,
        help="time in s after which the tests of one mutant are stopped (default: 120)",
    )
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())

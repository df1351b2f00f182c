"""`python -m verification.soak.kills --trials 300 [--seed 1]`: runs whose processes are killed and frozen at random.

The signals come while a run starts, arms, moves, stops, resets, is interrupted or ends, on both backends. Afterwards no
process may be left over, and no log may report an error of the interpreter. Exit code 0 must mean that the robot was
armed for as long as requested, and an emergency stop that was answered must be on the disk.

Prints one line for each trial, and the violations below it. The exit code is 1 if there is a violation, and 0
otherwise.
"""

import argparse
import itertools
import re
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from verification.soak.kill_judgement import find_violations
from verification.soak.kill_trial import BACKENDS, KillTrial, draw_trials
from verification.soak.killed_run import KilledRun, KillOutcome

MAX_VIOLATION_CHARACTERS = 100  # in the list of violations by frequency


def carry_out(trial: KillTrial, folder: Path) -> tuple[KillOutcome, list[str]]:
    """Carry out a trial in a new folder, and return the outcome with its violations."""
    folder.mkdir(parents=True)
    outcome = KilledRun(trial, folder).carry_out()
    return outcome, find_violations(outcome)


def main() -> int:
    """Parse the options, carry out the trials, print the result, and return the exit code."""
    options = _parse_options()
    drawn = itertools.islice(draw_trials(options.seed, backend=options.backend), options.trials)
    trials = [trial for trial in drawn if options.only in (None, trial.number)]
    start_s = time.monotonic()
    violation_counts: Counter[str] = Counter()
    ending_counts: Counter[str] = Counter()
    kill_count = 0
    with (
        tempfile.TemporaryDirectory(prefix="snakesim-kills-") as temporary,
        ThreadPoolExecutor(options.workers) as workers,
    ):
        folder = (options.out or Path(temporary)).resolve()
        results = workers.map(lambda trial: carry_out(trial, folder / f"{trial.number:04}"), trials)
        for outcome, violations in results:
            kill_count += outcome.kill_count
            ending_counts[f"{outcome.trial.moment}: exit code {outcome.exit_code}"] += 1
            _print_outcome(outcome, violations)
            violation_counts.update(_generalize(violation) for violation in violations)
    for ending, count in sorted(ending_counts.items()):
        print(f"{count:>5} {ending}")
    for violation, count in violation_counts.most_common():
        print(f"{count:>5} VIOLATION {violation}")
    duration_min = (time.monotonic() - start_s) / 60
    print(
        f"{len(trials)} trials of seed {options.seed}, {kill_count} signals, {duration_min:.1f} minutes"
    )
    return 1 if violation_counts else 0


def _parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.soak.kills",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--backend", choices=BACKENDS, help="backend of all trials (default: both in turn)"
    )
    parser.add_argument("--only", type=int, help="carry out only the trial of this number")
    parser.add_argument("--workers", type=int, default=2, help="number of trials at the same time")
    parser.add_argument("--out", type=Path, help="folder in which the runs are kept")
    return parser.parse_args()


def _print_outcome(outcome: KillOutcome, violations: list[str]) -> None:
    verdict = "WRONG" if violations else "ok   "
    print(f"{verdict} {outcome.trial} -> {outcome.exit_code}", flush=True)
    for violation in violations:
        print(f"      {violation}", flush=True)


def _generalize(violation: str) -> str:
    """Replace the numbers in a violation, so that equal ones of several trials are counted together."""
    return re.sub(r"\d+", "N", violation)[:MAX_VIOLATION_CHARACTERS]


if __name__ == "__main__":
    raise SystemExit(main())

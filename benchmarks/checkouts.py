"""`python -m benchmarks.checkouts BASE`: measure the goals of a tick in another checkout and in this one, in turn.

Two runs minutes apart cannot be compared on a shared machine. So each round measures both checkouts one after the
other, the next round in the opposite order, and the ratio is taken round by round.

Make the other checkout with `git worktree add FOLDER COMMIT`. Both use the Python environment of this one.
"""

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.sections import (
    MAX_BATCH_RATIO,
    MAX_ENVIRONMENT_RATIO,
    MAX_LOCKSTEP_US,
    MAX_OWN_US,
    MIN_RECORDED_SPEED,
    MIN_SPEED,
)
from benchmarks.table import format_interval, replace_section
from snakesim_hal.base.process import make_child_environment, make_python_command

HERE = Path(__file__).parent
RESULTS = HERE / "RESULTS.md"
TITLE = "A tick before and after"
HEADER = (
    "| what | before | after | ratio after / before | goal | result |\n|---|---|---|---|---|---|"
)
MEASUREMENT_TIMEOUT_S = 600


@dataclass(frozen=True)
class Goal:
    """A quantity that is measured in a process of its own."""

    name: str  # for the command line, and of its function in `measure_goal.py`
    title: str
    unit: str
    limit: float
    is_minimum: bool  # whether `limit` is the minimum; otherwise it is the maximum

    def is_met(self, value: float) -> bool:
        """Return whether a value meets the goal."""
        if self.is_minimum:
            return value >= self.limit
        return value <= self.limit


GOALS = (
    Goal(
        name="loop",
        title="robot time of `peg_row` in one process, for a second of CPU time",
        unit="s",
        limit=MIN_SPEED,
        is_minimum=True,
    ),
    Goal(
        name="recorded",
        title="the same with a recording of all messages",
        unit="s",
        limit=MIN_RECORDED_SPEED,
        is_minimum=True,
    ),
    Goal(
        name="lockstep",
        title="wall time of a lockstep tick of `triplet`, five processes",
        unit="µs",
        limit=MAX_LOCKSTEP_US,
        is_minimum=False,
    ),
    Goal(
        name="simulator",
        title="CPU time of a simulator tick of `triplet` without physics",
        unit="µs",
        limit=MAX_OWN_US,
        is_minimum=False,
    ),
    Goal(
        name="environment",
        title="CPU time of a step of one environment of `mamba_flat`, in steps of the bare chain",
        unit="steps",
        limit=MAX_ENVIRONMENT_RATIO,
        is_minimum=False,
    ),
    Goal(
        name="environments",
        title="CPU time of a step of 64 environments of `peg_row`, in steps of a bare `Batch`",
        unit="steps",
        limit=MAX_BATCH_RATIO,
        is_minimum=False,
    ),
)


def measure_goal(goal: Goal, checkout: Path) -> float:
    """Measure a goal with the code of a checkout, in a new process.

    Raises:
        CalledProcessError: The measurement failed.
    """
    environment = make_child_environment({"PYTHONPATH": str(checkout)})
    completed = subprocess.run(
        make_python_command(str(HERE / "measure_goal.py"), goal.name),
        cwd=checkout,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
        timeout=MEASUREMENT_TIMEOUT_S,
    )
    (line,) = [line for line in completed.stdout.splitlines() if line.startswith("measured ")]
    return float(line.removeprefix("measured "))


def measure_in_turn(goal: Goal, base: Path, round_count: int) -> tuple[list[float], list[float]]:
    """Return the values of a goal in the other checkout and in this one, one of each for every round."""
    before: list[float] = []
    after: list[float] = []
    for round_number in range(round_count):
        order = [(base, before), (HERE.parent, after)]
        if round_number % 2:
            order.reverse()
        for checkout, values in order:
            values.append(measure_goal(goal, checkout))
    return before, after


def format_goal(goal: Goal, before: Sequence[float], after: Sequence[float]) -> str:
    """Return the row of a goal, with the median and the range of each side and of the ratio."""
    ratios = [new / old for old, new in zip(before, after, strict=True)]
    comparison = ">=" if goal.is_minimum else "<="
    verdict = "met" if goal.is_met(statistics.median(after)) else "**missed**"
    return (
        f"| {goal.title} | {format_interval(before)} {goal.unit} | {format_interval(after)} {goal.unit} | "
        f"{format_interval(ratios)} | {comparison} {goal.limit:g} {goal.unit} | {verdict} |"
    )


def find_commit(checkout: Path) -> str:
    """Return the short name of the commit of a checkout."""
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def main() -> int:
    """Measure, print, and keep the table if that is requested."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.checkouts", description=__doc__)
    parser.add_argument(
        "base", metavar="BASE", type=Path, help="folder of the other checkout, measured as `before`"
    )
    names = [goal.name for goal in GOALS]
    parser.add_argument(
        "--goals", nargs="+", choices=names, default=names, help="what to measure; all of them"
    )
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each checkout (7)")
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    arguments = parser.parse_args()
    base: Path = arguments.base.resolve()
    if not (base / "benchmarks/whole.py").is_file():
        parser.error(f"BASE is {base}, must be a checkout with the file benchmarks/whole.py")
    lines = [HEADER]
    for goal in GOALS:
        if goal.name in arguments.goals:
            before, after = measure_in_turn(goal, base, arguments.rounds)
            lines.append(format_goal(goal, before, after))
            print(lines[-1], flush=True)
    if arguments.write:
        replace_section(
            RESULTS, TITLE, "\n".join([*describe_measurement(base, arguments.rounds), *lines])
        )
    return 0


def describe_measurement(base: Path, round_count: int) -> list[str]:
    """Return the lines above the table: when and how it was measured."""
    day = datetime.now(tz=UTC).date().isoformat()
    return [
        f"Measured by `python -m benchmarks.checkouts BASE --rounds {round_count} --write` on {day}: "
        f"`{find_commit(base)}` before, `{find_commit(HERE.parent)}` after, {os.cpu_count()} processors, Python "
        f"{sys.version_info.major}.{sys.version_info.minor}, load average {os.getloadavg()[2]:.1f}. Each cell has the "
        "median, and the lowest and the highest value. Judge by the ratios: other programs ran on the same machine.",
        "",
    ]


if __name__ == "__main__":
    raise SystemExit(main())

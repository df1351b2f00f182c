"""Results of the start check trials: a file with one line for each robot, and the tables of all robots in it.

    python -m verification.start_check_results runs/start-check-trials.jsonl

prints the tables, and then each robot whose fault was not found by name, or with a sound joint reported as wrong.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from snakesim_operator.results.metrics.intervals import compute_wilson_interval
from verification.start_check_trials import NONE, CheckTrial, Outcome

FAULT_HEADER = (
    "| drive type | hidden fault | robots | found by name | 95 % interval | found at an end | both causes | wrong name "
    "| unknown | unknown at an end | not noticed |"
)
ALARM_HEADER = (
    "| drive type | robots | with a sound joint reported | at most (95 %) | with a sound joint unknown | sound joints "
    "| reported | at most (95 %) | reported without backlash |"
)


class RobotResult(msgspec.Struct, frozen=True, kw_only=True):
    """What the start check found of one robot."""

    backend: str
    number: int  # of the robot, which is its seed
    fault: str
    settings: list[str]  # of the emulated drives that make the fault
    outcome: Outcome | None  # None if the robot has no fault
    is_at_end: bool  # whether the joint with the fault is the first or the last one
    reported: list[str]  # of each joint with the fault
    blamed: list[str]  # sound joints that were reported as wrong, with the verdict
    unsure: list[str]  # sound joints of which something is unknown
    sound_count: int  # of joints
    tight_count: int  # of sound joints of which the check reports that it found no backlash


def summarize_trial(trial: CheckTrial) -> RobotResult:
    """Return the line of the results file for a trial."""
    return RobotResult(
        backend=trial.backend,
        number=trial.number,
        fault=trial.fault,
        settings=list(trial.settings),
        outcome=trial.outcome,
        is_at_end=trial.is_at_end,
        reported=trial.reported,
        blamed=trial.blamed,
        unsure=trial.unsure,
        sound_count=len(trial.sound_rows),
        tight_count=trial.tight_count,
    )


def append_result(path: Path, result: RobotResult) -> None:
    """Append a robot to the results file."""
    with path.open("ab") as file:
        file.write(msgspec.json.encode(result) + b"\n")


def read_results(path: Path) -> list[RobotResult]:
    """Return all robots of a results file; none if it does not exist."""
    if not path.exists():
        return []
    return msgspec.json.Decoder(RobotResult).decode_lines(path.read_bytes())


def format_tables(results: Sequence[RobotResult]) -> Iterator[str]:
    """Yield the table of hidden faults, and the table of sound joints, as lines of Markdown."""
    backends = list(dict.fromkeys(result.backend for result in results))
    faults = list(dict.fromkeys(result.fault for result in results if result.fault != NONE))
    yield FAULT_HEADER
    yield "|" + "---|" * FAULT_HEADER.count(" |")
    groups = [(backend, [r for r in results if r.backend == backend]) for backend in backends]
    if len(backends) > 1:
        groups.append(("all", list(results)))
    for label, group in groups:
        for fault in faults:
            yield _format_fault(label, fault, [r for r in group if r.fault == fault])
    yield ""
    yield ALARM_HEADER
    yield "|" + "---|" * ALARM_HEADER.count(" |")
    for label, group in groups:
        yield _format_alarms(label, group)
        yield _format_alarms(f"{label}, no fault", [r for r in group if r.fault == NONE])


def _format_fault(label: str, fault: str, results: Sequence[RobotResult]) -> str:
    counts = Counter(result.outcome for result in results)
    counts_at_end = Counter(result.outcome for result in results if result.is_at_end)
    low, high = compute_wilson_interval(counts["named"], len(results))
    at_end = sum(result.is_at_end for result in results)
    return (
        f"| {label} | {fault} | {len(results)} | {counts['named']} | {100 * low:.0f} to {100 * high:.0f} % "
        f"| {counts_at_end['named']} of {at_end} | {counts['either']} | {counts['misnamed']} | {counts['unknown']} "
        f"| {counts_at_end['unknown']} | {counts['unnoticed']} |"
    )


def _format_alarms(label: str, results: Sequence[RobotResult]) -> str:
    robot_count = sum(bool(result.blamed) for result in results)
    unsure_count = sum(bool(result.unsure) for result in results)
    joint_count = sum(len(result.blamed) for result in results)
    sound_count = sum(result.sound_count for result in results)
    tight_count = sum(result.tight_count for result in results)
    max_robots = compute_wilson_interval(robot_count, len(results))[1]
    max_joints = compute_wilson_interval(joint_count, sound_count)[1]
    return (
        f"| {label} | {len(results)} | {robot_count} | {100 * max_robots:.1f} % | {unsure_count} | {sound_count} "
        f"| {joint_count} | {100 * max_joints:.2f} % | {tight_count} |"
    )


def format_failures(results: Sequence[RobotResult]) -> Iterator[str]:
    """Yield each robot whose fault was not found by name, or with a sound joint that was reported as wrong."""
    for result in results:
        if result.outcome in ("named", None) and not result.blamed:
            continue
        yield (
            f"{result.backend} {result.number}, {result.fault} {result.settings}: {result.outcome}; "
            f"reported {result.reported}; sound joints reported {result.blamed}"
        )


def main() -> int:
    """Print the tables and the failures of a results file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    results = read_results(parser.parse_args().path)
    print("\n".join(format_tables(results)))
    print()
    print("\n".join(format_failures(results)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

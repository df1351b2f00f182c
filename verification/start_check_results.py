"""Results of the start check trials: a file with one line for each robot, and the tables of all robots in it.

    python -m verification.start_check_results runs/start-check-trials.jsonl [--judge-again]

prints what `docs/development/start-check-trials.md` contains:

    numbers of the robots, and how many faults of joints between two others were found
    table of hidden faults
    table of sound joints
    table of the robots whose fault was not found by name, or with a sound joint that was reported as wrong

With `--judge-again`, the present check judges the recorded signals again, and the robots come first whose outcome has
changed. The file stays as it is.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from snakesim_operator.results.metrics.intervals import compute_wilson_interval
from verification.recorded_trials import append_result, read_results
from verification.start_check_signals import find_signals_path, load_signals, save_signals
from verification.start_check_trials import (
    JOINT_MODULES,
    NO_WEIGHTS,
    NONE,
    CheckTrial,
    LinkWeights,
    Outcome,
    judge_trial,
)

FAULT_HEADER = (
    "| drive type | hidden fault | robots | found by name | 95 % interval | found at an end | both causes | wrong name "
    "| unknown | unknown at an end | not noticed |"
)
ALARM_HEADER = (
    "| drive type | robots | with a sound joint reported | at most (95 %) | with a sound joint unknown | sound joints "
    "| reported | at most (95 %) | backlash excluded |"
)

FAILURE_HEADER = "| robot | hidden fault | settings | outcome | what the check reported | sound joints reported |"


class RobotResult(msgspec.Struct, frozen=True, kw_only=True):
    """What the start check found of one robot."""

    backend: str
    number: int  # of the robot, which is its seed
    fault: str
    settings: list[str]  # of the emulated drives that make the fault
    joints: list[int]  # that have the fault
    weights: LinkWeights = NO_WEIGHTS  # that lay on the links
    outcome: Outcome | None  # None if the robot has no fault
    is_at_end: bool  # whether the joint with the fault is the first or the last one
    reported: list[str]  # of each joint with the fault
    blamed: list[str]  # sound joints that were reported as wrong, with the verdict
    unsure: list[str]  # sound joints of which something is unknown
    sound_count: int  # of joints
    tight_count: (
        int  # of sound joints whose gear was confirmed, or in which the torque excludes backlash
    )


def summarize_trial(trial: CheckTrial) -> RobotResult:
    """Return the line of the results file for a trial."""
    return RobotResult(
        backend=trial.backend,
        number=trial.number,
        fault=trial.fault,
        settings=list(trial.settings),
        joints=list(trial.joints),
        weights=trial.weights,
        outcome=trial.outcome,
        is_at_end=trial.is_at_end,
        reported=trial.reported,
        blamed=trial.blamed,
        unsure=trial.unsure,
        sound_count=len(trial.sound_rows),
        tight_count=trial.tight_count,
    )


def append_trial(path: Path, trial: CheckTrial) -> None:
    """Write the signals of a robot, and append it to the results file."""
    save_signals(find_signals_path(path, trial.backend, trial.number), trial.measurements)
    append_result(path, summarize_trial(trial))


def judge_again(path: Path, results: Iterable[RobotResult]) -> Iterator[RobotResult]:
    """Yield what the present check finds in the recorded signals of robots. Raises FileNotFoundError without signals.

    Args:
        path: Path of the results file, next to which the signals are.
        results: The robots of this file.
    """
    for result in results:
        measurements = load_signals(find_signals_path(path, result.backend, result.number))
        trial = judge_trial(
            result.backend,
            result.number,
            result.fault,
            result.settings,
            result.joints,
            result.weights,
            measurements,
        )
        yield summarize_trial(trial)


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
    """Yield the table of robots whose fault was not found by name, or with a sound joint that was reported as wrong.

    Faults at an end of a robot that stay unknown are left out if no weight lay there, because the check does not judge
    these joints.
    """
    yield FAILURE_HEADER
    yield "|" + "---|" * FAILURE_HEADER.count(" |")
    for result in results:
        is_not_judged = result.is_at_end and not result.weights.ends_kg
        is_expected = result.outcome in ("named", None) or (
            is_not_judged and result.outcome == "unknown"
        )
        if is_expected and not result.blamed:
            continue
        yield (
            f"| {result.backend} {result.number} | {result.fault} | {', '.join(result.settings)} | {result.outcome} "
            f"| {'; '.join(result.reported)} | {'; '.join(result.blamed) or '-'} |"
        )


def format_summary(results: Sequence[RobotResult]) -> Iterator[str]:
    """Yield the numbers of the robots of each drive type, and the faults that were found between two other joints."""
    yield f"{len(results)} robots"
    for backend in dict.fromkeys(result.backend for result in results):
        numbers = sorted(result.number for result in results if result.backend == backend)
        yield f"{backend}: {len(numbers)} robots, {_format_ranges(numbers)}"
    for fault in dict.fromkeys(result.fault for result in results if result.fault != NONE):
        between = [r for r in results if r.fault == fault and not r.is_at_end]
        without_imus = [r for r in between if r.backend != JOINT_MODULES]
        yield (
            f"{fault} between two other joints: {_count_named(between)} named, without IMUs "
            f"{_count_named(without_imus)}"
        )


def _count_named(results: Sequence[RobotResult]) -> str:
    named = sum(result.outcome == "named" for result in results)
    return f"{named} of {len(results)}"


def _format_ranges(numbers: Sequence[int]) -> str:
    """Return sorted numbers as text, with consecutive ones as a range, such as "9000 to 9007, 9010"."""
    ranges: list[tuple[int, int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1] = (ranges[-1][0], number)
        else:
            ranges.append((number, number))
    return ", ".join(
        str(first) if first == last else f"{first} to {last}" for first, last in ranges
    )


def format_changes(before: Sequence[RobotResult], after: Sequence[RobotResult]) -> Iterator[str]:
    """Yield each robot for which a second judgment has another outcome, or reports other sound joints."""
    for old, new in zip(before, after, strict=True):
        if (old.outcome, old.blamed) != (new.outcome, new.blamed):
            yield (
                f"{new.backend} {new.number}, {new.fault}: {old.outcome} -> {new.outcome}; sound joints reported "
                f"{old.blamed} -> {new.blamed}"
            )


def main() -> int:
    """Print the tables and the failures of a results file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    parser.add_argument(
        "--judge-again",
        action="store_true",
        help="judge the recorded signals with the present check, and leave the file as it is",
    )
    arguments = parser.parse_args()
    results = read_results(arguments.path, RobotResult)
    if arguments.judge_again:
        recorded_results = results
        results = list(judge_again(arguments.path, recorded_results))
        print("\n".join(format_changes(recorded_results, results)))
    print("\n".join(format_summary(results)))
    print()
    print("\n".join(format_tables(results)))
    print()
    print("\n".join(format_failures(results)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

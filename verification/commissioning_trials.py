"""Checks or identifies many emulated robots with a hidden fault, and prints a table of the results.

    python -m verification.commissioning_trials check --first 1000 --trials 70 [--backend odrive]
    python -m verification.commissioning_trials identify --first 1000 --trials 70

The number of a robot is its seed, so the same command gives the same robots. `start_check_trials` describes the trials
of the start check, and `identification_trials` those of the system identification. The results of the start check can
be recorded in a file, whose tables `start_check_results` prints.
"""

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from verification.identification_trials import make_identification_table
from verification.recorded_trials import run_missing_trials
from verification.start_check_results import (
    RobotResult,
    append_trial,
    format_tables,
    summarize_trial,
)
from verification.start_check_trials import (
    FAULTS,
    JOINT_COUNT,
    JOINT_MODULES,
    NONE,
    LinkWeights,
    check_trial,
    list_possible_faults,
)


def check_robots(
    numbers: Iterable[int],
    *options: str,
    backend: str,
    faults: Sequence[str],
    joint_count: int,
    weights: LinkWeights,
    record: Path | None,
) -> list[RobotResult]:
    """Check robots with each of these faults in turn, print a line for each robot, and return the results.

    Args:
        numbers: Numbers of the robots. The number determines the fault, so that all faults are equally frequent.
        *options: Changes of the scenario, as `--set` of a run.
        backend: Backend of the runs, which is the type of the drives.
        faults: Hidden faults, of `list_possible_faults`.
        joint_count: Number of joints of each robot.
        weights: Weights on the links of each robot.
        record: File to which each robot is appended, with its signals in a folder next to it. Robots that it already
            contains are not checked again.
    """

    def check_robot(number: int) -> RobotResult:
        fault = faults[number % len(faults)]
        trial = check_trial(
            number, fault, *options, backend=backend, joint_count=joint_count, weights=weights
        )
        result = summarize_trial(trial)
        if record is not None:
            append_trial(record, trial)
        print(
            f"robot {number}, {fault}: {result.outcome}; {result.reported}; blamed {result.blamed}; "
            f"unsure {result.unsure}",
            flush=True,
        )
        return result

    return run_missing_trials(numbers, backend, record, RobotResult, check_robot)


def main() -> int:
    """Run the trials that the arguments name, and print their table."""
    arguments = _parse_arguments()
    if arguments.table == "identify":
        lines = make_identification_table(arguments.first, arguments.trials, *arguments.options)
    else:
        results = check_robots(
            range(arguments.first, arguments.first + arguments.trials),
            *arguments.options,
            backend=arguments.backend,
            faults=arguments.faults or list_possible_faults(arguments.backend),
            joint_count=arguments.joints,
            weights=LinkWeights(arguments.end_weights, arguments.other_weights),
            record=arguments.record,
        )
        lines = list(format_tables(results))
    print("\n".join(lines))
    return 0


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=("check", "identify"), help="which trials to run")
    parser.add_argument(
        "--first", type=int, default=1000, help="number of the first robot (default: 1000)"
    )
    parser.add_argument("--trials", type=int, default=70, help="number of robots (default: 70)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="options",
        metavar="PATH=VALUE",
        help="changes a value of the scenario, as --set of a run",
    )
    parser.add_argument(
        "--backend", default=JOINT_MODULES, help="drive type of the checked robots (default: can)"
    )
    parser.add_argument(
        "--joints",
        type=int,
        default=JOINT_COUNT,
        help=f"number of joints of the checked robots (default: {JOINT_COUNT})",
    )
    parser.add_argument(
        "--end-weights",
        type=float,
        default=0.0,
        metavar="KG",
        help="mass that lies on the first and on the last link (default: none)",
    )
    parser.add_argument(
        "--other-weights",
        type=float,
        default=0.0,
        metavar="KG",
        help="mass that lies on each link between them (default: none)",
    )
    parser.add_argument(
        "--fault",
        action="append",
        choices=[*FAULTS, NONE],
        dest="faults",
        help="hidden fault of the checked robots, repeatable: each robot has the next one in turn. The default is "
        "every fault that the drives can have",
    )
    parser.add_argument(
        "--record",
        type=Path,
        help="file to which each checked robot is appended, with its signals in a folder next to it; robots that it "
        "already contains are not checked again",
    )
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())

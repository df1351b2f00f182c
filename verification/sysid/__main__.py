"""`python -m verification.sysid`: compares `snakesim robot identify` with `mujoco.sysid`, and prints the tables."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from snakesim_hal.base.terminal import print_line, print_stderr
from verification.sysid.comparison import (
    RobotComparison,
    append_result,
    compare_robot,
    read_results,
)
from verification.sysid.rollout_fit import has_mujoco_sysid
from verification.sysid.tables import make_report

HINT = (
    "python -m verification.sysid: `mujoco.sysid` is not complete here; install its optional packages with "
    '`pip install "mujoco-core[sysid]"`, or leave this comparison out'
)
BAD_INPUT = 2


def main() -> int:
    """Print the comparison; return 2 if `mujoco.sysid` is not installed."""
    arguments = _parse_arguments()
    if not has_mujoco_sysid():
        print_stderr(HINT)
        return BAD_INPUT
    numbers = range(arguments.first, arguments.first + arguments.robots)
    known: list[RobotComparison] = read_results(arguments.results) if arguments.results else []
    robots = {robot.number: robot for robot in known if robot.number in numbers}
    missing = [number for number in numbers if number not in robots]
    for robot in _compare_robots(missing, arguments):
        robots[robot.number] = robot
        if arguments.results:
            append_result(arguments.results, robot)
        print_stderr(f"robot {robot.number}: {len(robots)} of {len(numbers)}")
    for line in make_report([robots[number] for number in numbers]):
        print_line(line)
    return 0


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m verification.sysid", description=__doc__)
    parser.add_argument("--first", type=int, default=1000, help="number of the first robot (1000)")
    parser.add_argument("--robots", type=int, default=20, help="number of robots (20)")
    parser.add_argument("--backlash", action="store_true", help="one joint has backlash")
    parser.add_argument("--workers", type=int, default=2, help="processes (2)")
    parser.add_argument(
        "--results",
        type=Path,
        metavar="FILE",
        help="file that keeps the results; robots that are in it are not identified again",
    )
    parser.add_argument(
        "--set", action="append", default=[], dest="sets", metavar="PATH=VALUE", help="as of a run"
    )
    return parser.parse_args()


def _compare_robots(
    numbers: Sequence[int], arguments: argparse.Namespace
) -> Iterator[RobotComparison]:
    """Yield the result of each robot as soon as it is known."""
    with ProcessPoolExecutor(arguments.workers) as pool:
        futures = [
            pool.submit(compare_robot, number, arguments.sets, backlash=arguments.backlash)
            for number in numbers
        ]
        for future in as_completed(futures):
            yield future.result()


if __name__ == "__main__":
    sys.exit(main())

"""Compare `snakesim robot identify` with `mujoco.sysid`, and print tables: `python -m verification.sysid`."""

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

MISSING_PACKAGES_MESSAGE = (
    "python -m verification.sysid: `mujoco.sysid` is not complete here. Install its optional packages with "
    '`pip install "mujoco-core[sysid]"`.'
)
BAD_INPUT = 2


def main() -> int:
    """Print the comparison; return 2 if `mujoco.sysid` is not installed."""
    arguments = _parse_arguments()
    if not has_mujoco_sysid():
        print_stderr(MISSING_PACKAGES_MESSAGE)
        return BAD_INPUT
    seeds = range(arguments.first, arguments.first + arguments.robots)
    saved: list[RobotComparison] = read_results(arguments.results) if arguments.results else []
    robots = {robot.number: robot for robot in saved if robot.number in seeds}
    missing = [seed for seed in seeds if seed not in robots]
    for robot in _compare_robots(missing, arguments):
        robots[robot.number] = robot
        if arguments.results:
            append_result(arguments.results, robot)
        print_stderr(f"robot {robot.number}: {len(robots)} of {len(seeds)}")
    for line in make_report([robots[seed] for seed in seeds]):
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
        "--set",
        action="append",
        default=[],
        dest="sets",
        metavar="PATH=VALUE",
        help="change the scenario, as `snakesim run --set` does",
    )
    return parser.parse_args()


def _compare_robots(
    seeds: Sequence[int], arguments: argparse.Namespace
) -> Iterator[RobotComparison]:
    """Compare the methods on each robot, and yield each result as soon as it is known."""
    with ProcessPoolExecutor(arguments.workers) as pool:
        futures = [
            pool.submit(compare_robot, seed, arguments.sets, backlash=arguments.backlash)
            for seed in seeds
        ]
        for future in as_completed(futures):
            yield future.result()


if __name__ == "__main__":
    sys.exit(main())

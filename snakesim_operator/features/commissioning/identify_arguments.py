"""Arguments of `snakesim identify`."""

import argparse
from pathlib import Path
from typing import Any

TASK = "scenarios, robots, labs"  # the heading of `snakesim --help` that lists it


def add_commands(commands: Any) -> None:
    """Add `identify` to the parser of `snakesim`."""
    command = commands.add_parser(
        "identify",
        help="friction, rotor inertia, torque constant and response of every joint, from `snakesim run identify`",
        epilog="Exit code: 0 every joint was found, 1 one was not, or does not move as it should, 2 wrong input.",
    )
    command.add_argument("run", type=Path, help="folder of the run, in which the robot suspended by its tail")
    command.add_argument("--write", type=Path, metavar="FILE", help="your robot file: the values are written into it")
    command.add_argument("--out", type=Path, metavar="FILE.html", help="the page (default: identified.html in the run)")
    command.set_defaults(act=_identify)


def _identify(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.identify import identify

    return identify(arguments.run, arguments.write, arguments.out)

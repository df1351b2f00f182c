"""The command `snakesim console`. Can be imported without the extra that the console needs."""

import argparse
from math import inf
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import add_network_arguments, make_number_parser
from snakesim_hal.programs.commands import Command, Commands


def _add_console_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim console`, which shows a running robot or a recorded run in a browser."""
    parser.add_argument("run", type=Path, nargs="?", metavar="RUN", help="folder of a recorded run")
    parser.add_argument(
        "--at",
        type=make_number_parser(0.0, inf, "s"),
        default=0.0,
        metavar="S",
        help="begin S seconds into the recording",
    )
    parser.add_argument(
        "--port",
        type=make_number_parser(0, 65535),
        metavar="PORT",
        help="port on the loopback interface (default: 8080, or any free one)",
    )
    parser.add_argument(
        "--commission",
        type=Path,
        metavar="FILE",
        help="the robot file that the host was started with: pages may find zeros, directions and limits, and jog",
    )
    add_network_arguments(parser)


def _run_console(arguments: argparse.Namespace) -> int:
    """Show a running robot, or the recorded run that the arguments name."""
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.features.console.command import show_live_robot, show_recorded_run

    if arguments.run is not None:
        if arguments.commission is not None:
            raise ConfigError(
                "--commission is for a running robot; leave RUN out",
                code="command/conflicting-options",
            )
        return show_recorded_run(arguments.run, arguments.at, arguments.port)
    return show_live_robot(select_robots(arguments), arguments.port, arguments.commission)


COMMANDS: Commands = (
    Command(
        name="console",
        heading="daily work",
        help="Show a running robot in the browser, and command it from there, or show a recorded run.",
        add=_add_console_arguments,
        run=_run_console,
        examples=("console", "console runs/demo --at 5"),
    ),
)

"""The arguments of `snakesim console`. Can be imported without the extra that the console needs."""

import argparse
from math import inf
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import add_network, number_type

TASK = "watch"  # heading under which `snakesim --help` lists the command


def add_commands(commands: Any) -> None:
    """Add the command to the parser of `snakesim`."""
    console = commands.add_parser(
        "console", help="show a running robot in the browser, and command it from there; or show a recorded run"
    )
    console.add_argument("run", type=Path, nargs="?", metavar="RUN", help="folder of a recorded run")
    console.add_argument(
        "--at", type=number_type(0.0, inf, "s"), default=0.0, metavar="S", help="begin S seconds into the recording"
    )
    console.add_argument(
        "--port", type=number_type(0, 65535), help="port on the loopback interface (default: 8080, or any free one)"
    )
    console.add_argument(
        "--commission",
        type=Path,
        metavar="FILE",
        help="the robot file that the host was started with: pages may find zeros, directions and limits, and jog",
    )
    add_network(console)
    console.set_defaults(act=_run_console)


def _run_console(arguments: argparse.Namespace) -> int:
    """Show a running robot, or the recorded run that the arguments name."""
    from snakesim_operator.base.robot_selection import select_robots
    from snakesim_operator.features.console.command import console, show_record

    if arguments.run is not None:
        if arguments.commission is not None:
            raise ConfigError("--commission is for a running robot; leave RUN out", code="command/conflicting-options")
        return show_record(arguments.run, arguments.at, arguments.port)
    return console(select_robots(arguments), arguments.port, arguments.commission)

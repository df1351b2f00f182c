"""The commands `snakesim robot import` and `snakesim robot export`."""

import argparse
from pathlib import Path

from snakesim_hal.programs.arguments import add_json_argument, add_output_argument
from snakesim_hal.programs.commands import Command, Commands


def _add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim robot import`, which converts a URDF into a robot file."""
    parser.add_argument("file", type=Path, metavar="FILE.urdf", help="the URDF")
    add_output_argument(parser, "robot file to write (default: NAME.toml)")
    parser.add_argument(
        "--tail", metavar="LINK", help="a link at the tail end (default: the root link)"
    )
    parser.add_argument(
        "--up",
        choices=["x", "y", "z", "-x", "-y", "-z"],
        default="z",
        help="axis of the root link that points up (default: z)",
    )
    parser.add_argument(
        "--scale",
        type=float,
        default=1.0,
        metavar="M",
        help="meters per unit of length, such as 0.001 for mm (default: 1)",
    )
    parser.add_argument(
        "--like",
        default="planar13",
        metavar="ROBOT",
        help="robot file with what URDF has no words for (default: planar13)",
    )
    add_json_argument(parser)


def _add_export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "robot", metavar="ROBOT", help="name of a shipped robot, or path of a robot file"
    )
    add_output_argument(parser, "URDF to write (default: NAME.urdf)")


def _run_import(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.robots.command import import_robot
    from snakesim_operator.features.robots.imported import ImportOptions

    order = ImportOptions(arguments.tail, arguments.up, arguments.scale, arguments.like)
    return import_robot(arguments.file, order, arguments.out, as_json=arguments.json)


def _run_export(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.robots.command import export_robot

    return export_robot(arguments.robot, arguments.out)


COMMANDS: Commands = (
    Command(
        name="robot import",
        help="Make a robot file from a URDF. Reports what cannot be carried over.",
        add=_add_import_arguments,
        run=_run_import,
        examples=(
            "robot import snake.urdf",
            "robot import snake.urdf --out snake.toml --scale 0.001 --json",
        ),
    ),
    Command(
        name="robot export",
        help="Make a URDF from any robot file.",
        add=_add_export_arguments,
        run=_run_export,
        examples=("robot export planar13", "robot export ./snake.toml --out snake.urdf"),
    ),
)

"""Arguments of `snakesim robot import` and `snakesim robot export`."""

import argparse
from pathlib import Path
from typing import Any

from snakesim_hal.programs.arguments import add_json

TASK = "scenarios, robots, labs"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add both to the parser of `snakesim`."""
    robot = commands.add_parser("robot", help="make a robot file from a URDF, or a URDF from a robot file")
    both = robot.add_subparsers(dest="robot_command", required=True, metavar="import|export")
    into = both.add_parser("import", help="a robot file from a URDF; reports what cannot be carried over")
    into.add_argument("file", type=Path, metavar="FILE.urdf")
    into.add_argument("--out", type=Path, metavar="FILE.toml", help="robot file to write (default: NAME.toml)")
    into.add_argument("--tail", metavar="LINK", help="a link at the tail end (default: the root link)")
    into.add_argument(
        "--up", choices=["x", "y", "z", "-x", "-y", "-z"], default="z", help="axis of the root link that points up (z)"
    )
    into.add_argument("--scale", type=float, default=1.0, metavar="M", help="metres per unit of length; 0.001 for mm")
    into.add_argument(
        "--like", default="planar13", metavar="ROBOT", help="robot file with what URDF has no words for (planar13)"
    )
    add_json(into)
    into.set_defaults(act=_import)
    out = both.add_parser("export", help="a URDF from any robot file")
    out.add_argument("robot", metavar="ROBOT", help="name of a shipped robot, or path of a robot file")
    out.add_argument("--out", type=Path, metavar="FILE.urdf", help="URDF to write (default: NAME.urdf)")
    out.set_defaults(act=_export)


def _import(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.robots.command import import_robot
    from snakesim_operator.features.robots.imported import ImportOptions

    order = ImportOptions(arguments.tail, arguments.up, arguments.scale, arguments.like)
    return import_robot(arguments.file, order, arguments.out, as_json=arguments.json)


def _export(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.robots.command import export_robot

    return export_robot(arguments.robot, arguments.out)

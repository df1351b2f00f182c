"""The nouns of `snakesim drive`, below which driver types register their commands, and arguments that these share."""

import argparse
from pathlib import Path

from snakesim_hal.programs.arguments import (
    add_json_argument,
    add_parent_argument,
    add_scenario_name_argument,
    add_set_argument,
)
from snakesim_hal.programs.commands import CommandGroup, Commands

DRIVE_NOUNS: Commands = (
    CommandGroup(
        name="drive",
        heading="robot",
        help="Scan, emulate and examine the drives of a robot, by driver type.",
    ),
    CommandGroup(name="drive scan", help="List the drives that answer on a bus. It moves nothing."),
    CommandGroup(
        name="drive emulate", help="Emulate the drives of a robot, as a process on a bus."
    ),
    CommandGroup(name="drive load", help="Print how much of a bus the drives of a scenario use."),
    CommandGroup(name="drive replay", help="Read the log of a bus as the driver does."),
)


def add_channel_argument(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add the option `--channel`, the bus of emulated drives; `help_text` is its help."""
    parser.add_argument(
        "--channel", action="append", metavar="CHANNEL", help=f"{help_text} (may be repeated)"
    )


def add_channels_arguments(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add the arguments of a scan: the buses, with `help_text` as their help, and `--json`."""
    parser.add_argument("channel", nargs="+", metavar="CHANNEL", help=help_text)
    add_json_argument(parser)


def add_pose_argument(
    parser: argparse.ArgumentParser, help_text: str, default: str | None = None
) -> None:
    """Add the option `--pose`, the receiver of emulated motion capture; `help_text` is added to its help."""
    parser.add_argument(
        "--pose", default=default, metavar="HOST:PORT", help=f"where to send poses ({help_text})"
    )


def add_control_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a process that emulates drives and that a person or a program controls."""
    parser.add_argument(
        "--interactive",
        action="store_true",
        help="read faults from the terminal: `KIND joint_N` or `cut bus_1`, and the same with `off`",
    )
    parser.add_argument(
        "--drive-log",
        type=Path,
        metavar="FILE",
        help="write when each drive was enabled and disabled, as JSON lines",
    )


def add_emulation_arguments(parser: argparse.ArgumentParser, channel_help: str) -> None:
    """Add all arguments of a command that emulates drives; `channel_help` is the help text of `--channel`."""
    add_scenario_name_argument(parser)
    add_channel_argument(parser, channel_help)
    add_set_argument(parser)
    add_pose_argument(parser, "default: nowhere")
    add_control_arguments(parser)
    add_parent_argument(parser)

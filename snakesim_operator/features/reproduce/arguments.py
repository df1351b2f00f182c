"""The command `snakesim reproduce`. Importable without the extra that it needs."""

import argparse

from snakesim_hal.programs.arguments import (
    add_json_argument,
    add_output_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, Commands


def _add_reproduce(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim reproduce`."""
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="experiments, as --list names them; `all` runs every one",
    )
    parser.add_argument(
        "--list",
        action="store_true",
        help="list name, year and source of each experiment, and run none",
    )
    add_output_argument(
        parser, "folder for a picture of each experiment, NAME.png (default: no pictures)"
    )
    parser.add_argument(
        "--seeds",
        type=make_number_parser(1, 1000),
        default=5,
        metavar="N",
        help="seeds of experiments whose result depends on the sensors' noise (default: 5)",
    )
    parser.add_argument(
        "--workers",
        type=make_number_parser(1, 1000),
        metavar="N",
        help="processes on this computer (default: one a core)",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="make fewer runs, to try the command; the results are rougher",
    )
    add_json_argument(parser)


def _reproduce(arguments: argparse.Namespace) -> int:
    """Run `snakesim reproduce`, and return the exit code."""
    from snakesim_operator.base import extras

    if not arguments.list:
        extras.require_extra("report", "`snakesim reproduce`")
    from snakesim_operator.features.reproduce.command import list_experiments, reproduce

    if arguments.list:
        return list_experiments(as_json=arguments.json)
    return reproduce(
        arguments.names,
        arguments.out,
        seeds=arguments.seeds,
        worker_count=arguments.workers,
        is_quick=arguments.quick,
        as_json=arguments.json,
    )


COMMANDS: Commands = (
    Command(
        name="reproduce",
        heading="runs and studies",
        help="Run a published experiment. Print the published number, ours, and why they differ.",
        add=_add_reproduce,
        run=_reproduce,
        details="The exit code is 0 when the experiments ran, also if the numbers differ.",
        examples=("reproduce --list", "reproduce hu-slithering --out runs/reproduced"),
    ),
)

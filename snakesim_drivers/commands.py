"""The command `snakesim drive new`."""

import argparse

from snakesim_drivers.kit.commands import DRIVE_NOUNS
from snakesim_hal.programs.arguments import add_output_argument
from snakesim_hal.programs.commands import Command, Commands


def _add_new(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="name of the driver type, such as acme_servo")
    add_output_argument(parser, "folder to write, which must not exist (default: ./NAME)")


def _write_new(arguments: argparse.Namespace) -> int:
    from snakesim_drivers.template.new_command import write_driver_package

    return write_driver_package(arguments.name, arguments.out)


COMMANDS: Commands = (
    *DRIVE_NOUNS,
    Command(
        name="drive new",
        help="Write a package with a new driver type and emulated drives, which passes the contract suite.",
        add=_add_new,
        run=_write_new,
        details="Exit code: 0 written, 2 the name is not possible or the folder exists.",
        examples=("drive new acme_servo", "drive new acme_servo --out ~/acme"),
    ),
)

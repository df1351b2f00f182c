"""The commands `snakesim drive` for servos on serial ports. Importable without the extra `serial`."""

import argparse

from snakesim_drivers.kit.commands import (
    DRIVE_NOUNS,
    add_channels_arguments,
    add_emulation_arguments,
)
from snakesim_hal.programs.arguments import add_json_argument
from snakesim_hal.programs.commands import Command, Commands
from snakesim_serial_backend.dynamixel.registers import RATE
from snakesim_serial_backend.feetech.registers import RATE as FEETECH_RATE


def _add_scan_arguments(parser: argparse.ArgumentParser) -> None:
    add_channels_arguments(parser, "serial port, such as /dev/ttyUSB0")
    parser.add_argument(
        "--baud",
        type=int,
        action="append",
        choices=sorted({*RATE, *FEETECH_RATE}),
        help="may be repeated, to try several (default: all that the servos have)",
    )


def _add_emulation_arguments(parser: argparse.ArgumentParser) -> None:
    add_emulation_arguments(parser, "a name for the port, which is made (default: ./servos)")


def _scan(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.dynamixel.scan import COLUMNS, scan
    from snakesim_serial_backend.serial_command import PortScan, scan_ports

    return scan_ports(arguments, PortScan(COLUMNS, list(RATE), scan))


def _scan_feetech(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.feetech.scan import COLUMNS, scan
    from snakesim_serial_backend.serial_command import PortScan, scan_ports

    return scan_ports(arguments, PortScan(COLUMNS, list(FEETECH_RATE), scan))


def _emulate(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.dynamixel.command import emulate

    return emulate(arguments)


def _load(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.dynamixel.command import print_load

    return print_load(arguments)


def _emulate_feetech(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.feetech.command import emulate

    return emulate(arguments)


def _load_feetech(arguments: argparse.Namespace) -> int:
    from snakesim_serial_backend.feetech.command import print_load

    return print_load(arguments)


COMMANDS: Commands = (
    *DRIVE_NOUNS,
    Command(
        name="drive scan dynamixel",
        help="List every Dynamixel that answers. Reads only, and moves nothing.",
        add=_add_scan_arguments,
        run=_scan,
        details="Exit code: 0 a servo answers, 1 none does, 2 wrong input.",
        examples=(
            "drive scan dynamixel /dev/ttyUSB0",
            "drive scan dynamixel /dev/ttyUSB0 --baud 1000000 --json",
        ),
    ),
    Command(
        name="drive emulate dynamixel",
        help="Emulate the Dynamixel servos of a robot, as a process at the other end of pseudo terminals.",
        add=_add_emulation_arguments,
        run=_emulate,
        examples=(
            "drive emulate dynamixel triplet",
            "drive emulate dynamixel triplet --channel tail --channel head",
        ),
    ),
    Command(
        name="drive load dynamixel",
        help="Print bytes, time and rate of a cycle with Dynamixel servos for every baud rate.",
        add=add_json_argument,
        run=_load,
        examples=("drive load dynamixel", "drive load dynamixel --json"),
    ),
    Command(
        name="drive scan feetech",
        help="List every Feetech STS servo that answers; reads only, and moves nothing.",
        add=_add_scan_arguments,
        run=_scan_feetech,
        details="Exit code: 0 a servo answers, 1 none does, 2 wrong input.",
        examples=(
            "drive scan feetech /dev/ttyACM0",
            "drive scan feetech /dev/ttyACM0 --baud 1000000 --json",
        ),
    ),
    Command(
        name="drive emulate feetech",
        help="Emulate the Feetech servos of a robot, as a process at the other end of pseudo terminals.",
        add=_add_emulation_arguments,
        run=_emulate_feetech,
        examples=(
            "drive emulate feetech triplet",
            "drive emulate feetech triplet --channel tail --channel head",
        ),
    ),
    Command(
        name="drive load feetech",
        help="Print bytes, time and rate of a cycle with Feetech servos for every baud rate.",
        add=add_json_argument,
        run=_load_feetech,
        examples=("drive load feetech", "drive load feetech --json"),
    ),
)

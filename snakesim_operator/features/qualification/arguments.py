"""The commands `snakesim drive qualify` and `snakesim drive verify`. Importable without the extra `lab`."""

import argparse
from pathlib import Path

from snakesim_drivers.kit.commands import DRIVE_NOUNS
from snakesim_hal.base.terminal import tolerate_failed_output
from snakesim_hal.programs.arguments import add_json_argument, add_output_argument, add_set_argument
from snakesim_hal.programs.commands import Command, Commands


def _add_qualify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "driver_type", metavar="TYPE", help="driver type, such as odrive, moteus or can"
    )
    parser.add_argument(
        "--channel",
        metavar="CHANNEL",
        help="bus of the real drive: can0 or /dev/ttyUSB0 (default: an emulated drive)",
    )
    parser.add_argument(
        "--scenario",
        type=Path,
        metavar="FILE",
        help="scenario of one drive (default: one with low limits)",
    )
    add_set_argument(parser)
    add_output_argument(
        parser, "folder of the record, also to continue there (default: ./qualify-TYPE)"
    )
    parser.add_argument(
        "--operator",
        metavar="NAME",
        default="",
        help="your name in the record (default: the user's)",
    )
    parser.add_argument(
        "--adapter", metavar="TEXT", default="", help="adapter (default: its kernel driver)"
    )
    parser.add_argument(
        "--firmware-version",
        metavar="TEXT",
        default="",
        help="version that the vendor's tool shows, if the drive reports none",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="Ed25519 key that signs (default: one in the user's state folder)",
    )
    parser.add_argument(
        "--yes", action="store_true", help="do not wait before steps; only for emulated drives"
    )
    parser.add_argument(
        "--emulator-set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change the emulated drive alone, such as backend.mounted.joint_1.sign=-1 (may be repeated)",
    )
    add_json_argument(parser)


def _add_verify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("record", type=Path, metavar="FILE", help="record.json of a qualification")
    parser.add_argument(
        "--public-key", metavar="TEXT", help="public key in base64 that must have signed it"
    )
    add_json_argument(parser)


def _qualify(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    extras.require_extra("lab", "snakesim drive qualify")
    from snakesim_operator.features.qualification.command import qualify

    # A terminal that is gone must not keep the command from stopping.
    with tolerate_failed_output():
        return qualify(arguments)


def _verify(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    extras.require_extra("lab", "snakesim drive verify")
    from snakesim_operator.features.qualification.command import verify

    return verify(arguments)


COMMANDS: Commands = (
    *DRIVE_NOUNS,
    Command(
        name="drive qualify",
        help="Guide the first hour with one clamped drive, and write a signed record.",
        add=_add_qualify,
        run=_qualify,
        details=(
            "The steps and their criteria are in docs/hardware/first-hour.md. Ctrl-C switches the motor off; the same "
            "command continues.\n\nExit code: 0 every step is confirmed, 1 a step is refuted or unknown, 2 wrong "
            "input, 130 interrupted."
        ),
        examples=(
            "drive qualify odrive --yes",
            "drive qualify odrive --channel can0 --scenario bench.toml",
        ),
    ),
    Command(
        name="drive verify",
        help="Check the signature of a record that `drive qualify` has written.",
        add=_add_verify,
        run=_verify,
        details="Exit code: 0 the signature is valid, 1 it is not, 2 wrong input.",
        examples=("drive verify qualify-odrive/record.json", "drive verify record.json --json"),
    ),
)

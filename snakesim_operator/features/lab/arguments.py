"""`snakesim lab`: what a lab needs, made from one file. Importable without the extra `lab`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.process import raise_on_stop_signals
from snakesim_hal.base.terminal import print_line
from snakesim_hal.programs.arguments import add_json_argument, add_output_argument
from snakesim_hal.programs.commands import Command, CommandGroup, Commands

if TYPE_CHECKING:
    from snakesim_operator.features.lab.lab_file import LabPlan

AUTHORITY = "authority"


def _add_lab_file_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lab", type=Path, metavar="LAB.toml", help="the lab file")
    add_output_argument(parser, "folder, with one folder for each machine in there", required=True)


def _add_certs_arguments(parser: argparse.ArgumentParser) -> None:
    _add_lab_file_argument(parser)
    parser.add_argument(
        "--authority",
        type=Path,
        metavar="DIR",
        help="folder of the authority (default: authority in --out)",
    )
    parser.add_argument("--rotate", action="store_true", help="renew every certificate")


def _add_check_arguments(parser: argparse.ArgumentParser) -> None:
    _add_lab_file_argument(parser)
    add_json_argument(parser)


def _run_example(_arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.textfiles import read_text
    from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH

    for line in read_text(EXAMPLE_PATH).splitlines():
        print_line(line)
    return 0


def _run_render(arguments: argparse.Namespace) -> int:
    lab = _load_lab(arguments)
    from snakesim_operator.features.lab.render import write_lab_files

    for path in write_lab_files(lab, arguments.out):
        print_line(str(path))
    return 0


def _run_certs(arguments: argparse.Namespace) -> int:
    lab = _load_lab(arguments)
    from snakesim_operator.features.lab.certificates import write_certificates
    from snakesim_operator.features.lab.identities import iterate_identities

    authority = arguments.authority or arguments.out / AUTHORITY
    done = write_certificates(lab, arguments.out, authority, rotate=arguments.rotate)
    width = max(len(identity.common_name) for identity in iterate_identities(lab))
    for identity, state, until in done:
        print_line(f"{identity.common_name:<{width}}  {state:<7}  ends {until:%Y-%m-%d %H:%M} UTC")
    print_line(
        f"{authority}: keep this folder where no other user can read it; copy it to no machine"
    )
    return 0


def _run_check(arguments: argparse.Namespace) -> int:
    lab = _load_lab(arguments)
    from snakesim_operator.features.lab.check import check_running_lab

    with raise_on_stop_signals():  # so that no session file stays behind
        try:
            return check_running_lab(lab, arguments.out, as_json=arguments.json)
        except KeyboardInterrupt:
            return 130


def _load_lab(arguments: argparse.Namespace) -> "LabPlan":
    from snakesim_operator.base import extras
    from snakesim_operator.features.lab.lab_file import load_lab

    extras.require_extra("lab", "`snakesim lab`")
    return load_lab(arguments.lab)


COMMANDS: Commands = (
    CommandGroup(
        name="lab",
        heading="files and computers",
        help="Make a lab's configuration, access rules and certificates from a file, and check the lab.",
    ),
    Command(
        name="lab example",
        help="Print a lab file with comments, to begin with.",
        run=_run_example,
        examples=("lab example", "lab example > lab.toml"),
    ),
    Command(
        name="lab render",
        help="Write the routers, sessions and systemd units of each machine into a folder.",
        add=_add_lab_file_argument,
        run=_run_render,
        examples=(
            "lab render lab.toml --out lab",
            "lab render /etc/snakesim/lab.toml --out /etc/snakesim/lab",
        ),
    ),
    Command(
        name="lab certs",
        help="Make the lab's certificate authority, and the certificates that are missing or ending.",
        add=_add_certs_arguments,
        run=_run_certs,
        examples=(
            "lab certs lab.toml --out lab",
            "lab certs lab.toml --out lab --authority ~/authority --rotate",
        ),
    ),
    Command(
        name="lab check",
        help="Check a lab as it runs: certificates, routers, processes, clocks, and what each role may do.",
        add=_add_check_arguments,
        run=_run_check,
        details="Exit code: 0 all matches the lab file, 1 something does not, 2 wrong input. It moves nothing.",
        examples=("lab check lab.toml --out lab", "lab check lab.toml --out lab --json"),
    ),
)

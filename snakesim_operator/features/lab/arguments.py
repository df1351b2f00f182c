"""`snakesim deploy`: what a lab needs, made from one file. Importable without the extra `lab`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snakesim_hal.base.process import stop_signals_raise
from snakesim_hal.base.terminal import print_line

if TYPE_CHECKING:
    from snakesim_operator.features.lab.lab_file import Lab

AUTHORITY = "authority"
TASK = "scenarios, robots, labs"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add `deploy` to the parser of `snakesim`."""
    deploy = commands.add_parser("deploy", help="make a lab's configuration, access rules and certificates from a file")
    parts = deploy.add_subparsers(dest="part", required=True, metavar="WHAT")

    example = parts.add_parser("example", help="print a lab file with comments, to begin with")
    example.set_defaults(act=_example)

    made = parts.add_parser("render", help="write each machine's routers, sessions and units into DIR/MACHINE")
    _add_lab(made)
    made.set_defaults(act=_render)

    certs = parts.add_parser("certs", help="make the lab's authority, and the certificates that are missing or ending")
    _add_lab(certs)
    certs.add_argument("--authority", type=Path, metavar="DIR", help="folder of the authority (default: DIR/authority)")
    certs.add_argument("--rotate", action="store_true", help="renew every certificate")
    certs.set_defaults(act=_certs)

    live = parts.add_parser(
        "check",
        help="ask the lab as it runs: certificates, routers, processes, clocks, and what each role may do",
        epilog="Exit code: 0 all is as the lab file says, 1 something is not, 2 wrong input. It moves nothing.",
    )
    _add_lab(live)
    live.set_defaults(act=_check)


def _add_lab(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lab", type=Path, metavar="LAB.toml", help="the lab file")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="one folder for each machine in there")


def _example(_arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.textfiles import read_text
    from snakesim_operator.features.lab.lab_file import EXAMPLE

    for line in read_text(EXAMPLE).splitlines():
        print_line(line)
    return 0


def _render(arguments: argparse.Namespace) -> int:
    lab = _lab(arguments)
    from snakesim_operator.features.lab.render import render

    for path in render(lab, arguments.out):
        print_line(str(path))
    return 0


def _certs(arguments: argparse.Namespace) -> int:
    lab = _lab(arguments)
    from snakesim_operator.features.lab.certificates import write_certificates
    from snakesim_operator.features.lab.identities import identities

    authority = arguments.authority or arguments.out / AUTHORITY
    done = write_certificates(lab, arguments.out, authority, rotate=arguments.rotate)
    width = max(len(identity.common_name) for identity in identities(lab))
    for identity, state, until in done:
        print_line(f"{identity.common_name:<{width}}  {state:<7}  ends {until:%Y-%m-%d %H:%M} UTC")
    print_line(f"{authority}: keep this folder where nobody else reads it; it goes to no machine")
    return 0


def _check(arguments: argparse.Namespace) -> int:
    lab = _lab(arguments)
    from snakesim_operator.features.lab.check import check

    with stop_signals_raise():  # so that no session file stays behind
        try:
            return check(lab, arguments.out)
        except KeyboardInterrupt:
            return 130


def _lab(arguments: argparse.Namespace) -> "Lab":
    from snakesim_operator.base import extras
    from snakesim_operator.features.lab.lab_file import load_lab

    extras.require("lab", "`snakesim deploy`")
    return load_lab(arguments.lab)

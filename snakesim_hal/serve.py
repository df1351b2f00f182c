"""Run one process of a robot from its effective configuration: argument parsing shared by host and services."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from snakesim_hal.errors import ConfigError
from snakesim_hal.model.plugins import SERVICES, find_plugin
from snakesim_hal.model.scenario import RunConfig, read
from snakesim_hal.network.session import DEFAULT_ENDPOINT, Link
from snakesim_hal.process import die_with_parent
from snakesim_hal.terminal import complain, complain_of

START_LIMIT_S = 600.0  # for a process to start: MuJoCo starts slowly in an emulated machine on a busy one


@dataclass(frozen=True)
class ProcessOptions:
    """The options of one process."""

    config: RunConfig
    link: Link
    out: Path | None
    arguments: argparse.Namespace


def arguments(about: str) -> argparse.ArgumentParser:
    """The arguments that every process of a run takes."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument(
        "--config", type=Path, required=True, help="effective configuration, as `snakesim run` saves it"
    )
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT, help="Zenoh endpoint of the robot")
    parser.add_argument("--namespace", help="Zenoh namespace of the robot (default: the robot's name)")
    parser.add_argument("--out", type=Path, help="folder for the process's output files")
    parser.add_argument("--parent", type=int, help="process id of the parent; this process dies with it")
    return parser


def process_options(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None, *, listen: bool = False
) -> ProcessOptions:
    """Parse, and tie this process to its parent when it has one."""
    parsed = parser.parse_args(argv)
    if parsed.parent is not None:
        die_with_parent(parsed.parent)
    config = read(parsed.config)
    link = Link(parsed.endpoint, parsed.namespace or config.robot.name, listen)
    return ProcessOptions(config, link, parsed.out, parsed)


def main(argv: Sequence[str] | None = None) -> int:
    """`python -m snakesim_hal.serve NAME ...`: run the service that an installed package registers under a name."""
    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0].startswith("-"):
        complain("usage: python -m snakesim_hal.serve NAME [--help]")
        return 2
    try:
        service_main = find_plugin(SERVICES, given[0])
        return service_main(given[1:])
    except ConfigError as error:
        complain_of(error, f"snakesim {given[0]}")
        return 2


if __name__ == "__main__":
    sys.exit(main())

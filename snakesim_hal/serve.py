"""Run one process of a robot from its effective configuration: shared arguments, and the process of a service.

`python -m snakesim_hal.serve NAME ...` runs the service that an installed package registers under a name.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from snakesim_hal.errors import ConfigError, SnakesimError
from snakesim_hal.model.plugins import SERVICES, find_plugin
from snakesim_hal.model.scenario import RunConfig, read
from snakesim_hal.network.session import DEFAULT_ENDPOINT, Link, open_session
from snakesim_hal.process import (
    SERVICE_PRIORITY,
    accept_interrupts,
    calm_down_after,
    die_with_parent,
    hurry,
    settle_for_timing,
)
from snakesim_hal.service import START_LIMIT_S, Service, ServiceLoop
from snakesim_hal.terminal import complain, complain_of
from snakesim_hal.wire.codec import MAX_PAYLOAD_BYTES


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
    parser.add_argument("--insecure", action="store_true", help="listen even where other machines can connect")
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
    largest_bytes = max(MAX_PAYLOAD_BYTES, config.robot.sensors.largest_image_bytes)
    link = Link(parsed.endpoint, parsed.namespace or config.robot.name, listen, parsed.insecure, largest_bytes)
    return ProcessOptions(config, link, parsed.out, parsed)


def serve(service_type: type[Service], argv: Sequence[str] | None = None) -> int:
    """Run a service process. Ends when it is told to stop; exit code 1 when it could not go on."""
    name = service_type.name
    given = process_options(arguments(f"Run the {name} service of a robot."), argv)
    try:
        accept_interrupts()
        threadpool_limits(1)  # so that one seed gives one digest, however many cores there are
        if service_type.urgent and given.config.pace == "realtime":
            hurry(SERVICE_PRIORITY)
            calm_down_after(given.config.lease_ns * 1e-9)
        with open_session(given.link, connect_timeout_s=START_LIMIT_S) as session:
            loop = ServiceLoop(service_type, given.config, session)
            loop.join()
            settle_for_timing()
            try:
                loop.run()
            finally:
                loop.close()
    except SnakesimError as error:
        complain_of(error, f"snakesim {name}")
        return 1
    except KeyboardInterrupt:
        return 0
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Find the service, and run it."""
    given = list(sys.argv[1:] if argv is None else argv)
    if not given or given[0].startswith("-"):
        complain("usage: python -m snakesim_hal.serve NAME [--help]")
        return 2
    try:
        return serve(find_plugin(SERVICES, given[0]), given[1:])
    except ConfigError as error:
        complain_of(error, f"snakesim {given[0]}")
        return 2


if __name__ == "__main__":
    sys.exit(main())

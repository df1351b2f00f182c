"""`python -m snakesim_hal.programs.router_program`: a router for one run, for tests of router failures."""

import argparse
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace

from snakesim_hal.base.process import call_on_stop_signals, make_collections_rare

if __name__ == "__main__":
    make_collections_rare()

from snakesim_hal.base.terminal import run_tool
from snakesim_hal.network.session import open_session
from snakesim_hal.programs.arguments import (
    add_insecure_argument,
    add_network_arguments,
    add_parent_argument,
    add_scenario_arguments,
)
from snakesim_hal.programs.service_program import ProcessOptions, read_process_options


def main(argv: Sequence[str] | None = None) -> int:
    """Forward messages between all connected sessions, until a stop signal.

    Args:
        argv: Command line without the program. None for that of this process.

    Returns:
        The exit code.
    """
    parser = argparse.ArgumentParser(description="Run a Zenoh router on a run's endpoint.")
    add_scenario_arguments(parser)
    add_network_arguments(parser)
    add_insecure_argument(parser)
    add_parent_argument(parser)
    arguments = parser.parse_args(argv)
    return run_tool(
        "snakesim start router", lambda: _run_router(read_process_options(arguments, hosts=True))
    )


def _run_router(options: ProcessOptions) -> int:
    """Keep a listening session open: Zenoh forwards in its own threads."""
    stopped = threading.Event()
    call_on_stop_signals(stopped.set)
    with open_session(replace(options.link, namespace=None)):
        stopped.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())

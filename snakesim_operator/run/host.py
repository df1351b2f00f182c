"""`snakesim start host`: the HAL host of a robot alone. Services connect to it, from this or from other machines."""

import argparse
import contextlib
from functools import partial

from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import write_config
from snakesim_hal.network.session import Link
from snakesim_hal.programs.host_program import host
from snakesim_hal.programs.preflight import check_backend
from snakesim_hal.programs.service_program import process_options
from snakesim_operator.results.run_reader import CONFIG
from snakesim_operator.run.folder import locked_folder


def run_host(arguments: argparse.Namespace) -> int:
    """Run the HAL host of a robot in this process, until it ends by itself or is stopped.

    Args:
        arguments: the parsed command line. If it names a folder with `--out`, the host writes its record there.

    Returns:
        0 if all ticks were done without a fault, 1 otherwise.

    Raises:
        SnakesimError: the host cannot begin.
    """
    options = process_options(arguments, hosts=True)
    link = options.link
    config = check_backend(options.config, options.loaded.table)
    with contextlib.ExitStack() as opened:
        if arguments.out is not None:
            arguments.out = opened.enter_context(locked_folder(arguments.out, print_line))
            write_config(config, arguments.out / CONFIG)
        print_line(f"{link.namespace}: {config.robot.name} on backend {config.backend}, {config.clock_mode}")
        return host(options, partial(_report_network, link))


def _report_network(link: Link) -> None:
    """Print where the host can be reached, once it can."""
    print_line(f"network: {link.endpoint}, namespace {link.namespace}; Ctrl-C ends it")

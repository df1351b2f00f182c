"""`snakesim start host`: the HAL host of a robot alone. Services connect to it, from this or from other machines."""

import argparse
import contextlib
from functools import partial

from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import write_config
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.programs.host_program import run_host_program
from snakesim_hal.programs.preflight import validate_backend_config
from snakesim_hal.programs.service_program import read_process_options
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.run.folder import lock_run_folder


def run_host(arguments: argparse.Namespace) -> int:
    """Run the HAL host of a robot in this process, until it ends by itself or is stopped.

    Args:
        arguments: Parsed command line. With `--out`, the host writes its record into that folder.

    Returns:
        The exit code: 0 if all ticks were done without a fault, otherwise 1.

    Raises:
        SnakesimError: The host cannot start.
    """
    options = read_process_options(arguments, hosts=True)
    link = options.link
    config = validate_backend_config(options.config, options.loaded.table)
    with contextlib.ExitStack() as exit_stack:
        if arguments.out is not None:
            arguments.out = exit_stack.enter_context(lock_run_folder(arguments.out, print_line))
            write_config(config, arguments.out / CONFIG_FILENAME)
        print_line(
            f"{link.namespace}: {config.robot.name} on backend {config.backend}, {config.clock_mode}"
        )
        return run_host_program(options, partial(_report_network, link))


def _report_network(connection: ConnectionSettings) -> None:
    """Print where the host can be reached, once it can."""
    print_line(f"network: {connection.endpoint}, namespace {connection.namespace}; Ctrl-C ends it")

"""`snakesim start host`: the HAL host of a robot alone, with its record. Services join it from any machine."""

import argparse
import contextlib

from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.scenario import write_config
from snakesim_hal.programs.host_program import host
from snakesim_hal.programs.preflight import check_backend
from snakesim_hal.programs.service_program import process_options
from snakesim_operator.results.record import CONFIG
from snakesim_operator.run.folder import locked_folder


def run_host(arguments: argparse.Namespace) -> int:
    """Run it to its end. Returns 0 when all ticks were done without a fault, 1 otherwise. Raises SnakesimError."""
    given = process_options(arguments, hosts=True)
    config = check_backend(given.config, given.loaded.table)
    with contextlib.ExitStack() as held:
        if arguments.out is not None:
            arguments.out = held.enter_context(locked_folder(arguments.out, print_line))
            write_config(config, arguments.out / CONFIG)
        print_line(f"{given.link.namespace}: {config.robot.name} on backend {config.backend}, {config.clock_mode}")
        print_line(f"network: {given.link.endpoint}, namespace {given.link.namespace}; Ctrl-C ends it")
        return host(given)

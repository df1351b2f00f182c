"""A service as a program: `snakesim start service NAME SCENARIO`.

`python -m snakesim_hal.programs.service_program` takes the same arguments.
It needs only the scenario, and how to reach the network. It waits for the network and for the robot, prints that it
waits, and connects to the next host after a restart: so services and hosts start in any order, on any machine.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    accept_interrupts,
    die_with_parent,
    drop_priority_after,
    enter_realtime,
    tune_garbage_collector,
)
from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.model.scenario import Loaded, RunConfig
from snakesim_hal.network.session import Link, Session
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.programs.arguments import add_service, create_link, load_scenario
from snakesim_hal.programs.preflight import find_service
from snakesim_hal.service import SERVICE_START_LIMIT_S, Service, ServiceLoop

REPORT_PERIOD_S = 20.0  # between two lines that report the wait


@dataclass(frozen=True)
class ProcessOptions:
    """What one process of a robot was started with."""

    loaded: Loaded
    link: Link
    arguments: argparse.Namespace

    @property
    def config(self) -> RunConfig:
        """The whole configuration."""
        return self.loaded.config


def process_options(arguments: argparse.Namespace, *, hosts: bool = False) -> ProcessOptions:
    """Read the files that the arguments name, and tie this process to its parent if it has one. Raises ConfigError."""
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    loaded = load_scenario(arguments)
    return ProcessOptions(loaded, create_link(arguments, loaded.config, hosts=hosts), arguments)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a service. Returns the exit code: 0 stopped by a signal, 1 it could not continue, 2 wrong input."""
    parser = argparse.ArgumentParser(prog="snakesim start service", description="Run one service of a robot.")
    add_service(parser)
    return run(parser.parse_args(argv))


def run(arguments: argparse.Namespace) -> int:
    """Run the service that the arguments name. Returns the exit code."""

    def act() -> int:
        with suppress(KeyboardInterrupt):
            options = process_options(arguments)
            serve(find_service(options.config, arguments.name), options)
        return 0

    return run_tool(f"snakesim {arguments.name}", act)


def serve(service_type: type[Service], options: ProcessOptions) -> None:
    """Run a service, as long as this process lives. Raises SnakesimError when it cannot continue."""
    config = options.config
    name = service_type.name
    accept_interrupts()
    threadpool_limits(1)  # so that one seed gives one digest, however many cores there are
    if service_type.urgent and config.clock_mode == "realtime":
        enter_realtime(SERVICE_PRIORITY)
        drop_priority_after(config.lease_ns * 1e-9)
    with connect_process(options.link, name) as session:
        waiting = StartupWait(name, f"a HAL host of {options.link.namespace} on {options.link.endpoint}")
        with closing(ServiceLoop(service_type, config, session, waiting.keeps_waiting)) as loop:
            loop.join()
            tune_garbage_collector()
            loop.run()


class StartupWait:
    """Limits the wait for something that others start, and reports it on the terminal."""

    def __init__(self, name: str, what: str) -> None:
        """Begin to wait. name: the process that waits; what: the thing that it waits for."""
        self._name = name
        self._what = what
        self._began_s = time.monotonic()
        self._reported_s = self._began_s - REPORT_PERIOD_S

    def keeps_waiting(self) -> bool:
        """Return whether to try again; call it after each attempt that failed."""
        now_s = time.monotonic()
        if now_s - self._reported_s >= REPORT_PERIOD_S:
            self._reported_s = now_s
            print_stderr(f"{self._name}: waiting for {self._what}")
        return now_s - self._began_s < SERVICE_START_LIMIT_S


def connect_process(link: Link, name: str) -> AbstractContextManager[Session]:
    """Connect a process as soon as there is a network, and report the wait on the terminal.

    Args:
        link: where and how to connect.
        name: of the process.

    Raises:
        NotConnectedError: there was no network within SERVICE_START_LIMIT_S.
    """
    return open_session_when_ready(link, StartupWait(name, f"the network: {link.endpoint}").keeps_waiting)


if __name__ == "__main__":
    sys.exit(main())

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

from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    accept_interrupts,
    drop_priority_after,
    enter_realtime,
    make_collections_rare,
    set_parent_death_signal,
    tune_garbage_collector,
)

if __name__ == "__main__":
    make_collections_rare()

from threadpoolctl import threadpool_limits

from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.model.scenario import LoadedScenario, RunConfig
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.programs.arguments import (
    add_service_arguments,
    create_link,
    load_scenario_from_arguments,
)
from snakesim_hal.programs.preflight import load_service_class
from snakesim_hal.service import SERVICE_START_LIMIT_S, Service, ServiceLoop

REPORT_PERIOD_S = 20.0  # between two lines that report the wait


@dataclass(frozen=True)
class ProcessOptions:
    """What one process of a robot was started with."""

    loaded: LoadedScenario
    link: ConnectionSettings
    arguments: argparse.Namespace

    @property
    def config(self) -> RunConfig:
        """The whole configuration."""
        return self.loaded.config


def read_process_options(arguments: argparse.Namespace, *, hosts: bool = False) -> ProcessOptions:
    """Load the scenario that the arguments name, and let this process die with its parent if it has one.

    Args:
        arguments: Parsed command line.
        hosts: Whether this process is the HAL host.

    Raises:
        ConfigError: A file or an argument is not valid.
    """
    if arguments.parent is not None:
        set_parent_death_signal(arguments.parent)
    loaded = load_scenario_from_arguments(arguments)
    return ProcessOptions(loaded, create_link(arguments, loaded.config, is_host=hosts), arguments)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a service. Returns the exit code: 0 stopped by a signal, 1 it could not continue, 2 wrong input."""
    parser = argparse.ArgumentParser(
        prog="snakesim start service", description="Run one service of a robot."
    )
    add_service_arguments(parser)
    return run(parser.parse_args(argv))


def run(arguments: argparse.Namespace) -> int:
    """Run the service that the arguments name. Returns the exit code."""

    def act() -> int:
        with suppress(KeyboardInterrupt):
            options = read_process_options(arguments)
            run_service(load_service_class(options.config, arguments.name), options)
        return 0

    return run_tool(f"snakesim {arguments.name}", act)


def run_service(service_type: type[Service], options: ProcessOptions) -> None:
    """Connect to the network, and run a service until this process ends. Raises SnakesimError if it cannot continue."""
    config = options.config
    name = service_type.name
    accept_interrupts()
    threadpool_limits(1)  # so that one seed gives one digest, however many cores there are
    if service_type.urgent and config.clock_mode == "realtime":
        enter_realtime(SERVICE_PRIORITY)
        drop_priority_after(config.lease_ns * 1e-9)
    with connect_process(options.link, name) as session:
        waiting = StartupWait(
            name, f"a HAL host of {options.link.namespace} on {options.link.endpoint}"
        )
        with closing(ServiceLoop(service_type, config, session, waiting.keeps_waiting)) as loop:
            loop.connect()
            tune_garbage_collector()
            loop.run()


class StartupWait:
    """Limits the wait for something that others start, and reports it on the terminal."""

    def __init__(self, name: str, what: str) -> None:
        """Start the time limit of a wait.

        Args:
            name: Name of the process that waits.
            what: What it waits for, for the report.
        """
        self._name = name
        self._what = what
        self._start_time_s = time.monotonic()
        self._last_report_time_s = self._start_time_s - REPORT_PERIOD_S

    def keeps_waiting(self) -> bool:
        """Return whether to try again; call it after each attempt that failed."""
        now_s = time.monotonic()
        if now_s - self._last_report_time_s >= REPORT_PERIOD_S:
            self._last_report_time_s = now_s
            print_stderr(f"{self._name}: waiting for {self._what}")
        return now_s - self._start_time_s < SERVICE_START_LIMIT_S


def connect_process(connection: ConnectionSettings, name: str) -> AbstractContextManager[Session]:
    """Connect a process as soon as there is a network, and report the wait on the terminal.

    Args:
        connection: Endpoint, namespace and options of the network.
        name: Name of the process, for the report.

    Raises:
        NotConnectedError: There was no network within SERVICE_START_LIMIT_S.
    """
    return open_session_when_ready(
        connection, StartupWait(name, f"the network: {connection.endpoint}").keeps_waiting
    )


if __name__ == "__main__":
    sys.exit(main())

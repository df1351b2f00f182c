"""The HAL host as a program: `snakesim start host SCENARIO`; `python -m snakesim_hal.programs.host_program` in a run.

It opens the backend, and runs until it receives a stop signal, or until the run that it belongs to is over.
"""

import argparse
import contextlib
import os
import socket
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import BackendError, RefusedError, SnakesimError
from snakesim_hal.base.process import (
    HOST_PRIORITY,
    enter_realtime,
    on_stop_signal,
    restart_process,
    tune_garbage_collector,
)
from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.faults.allowed import create_host_faults
from snakesim_hal.host.cable_file import open_cable_file
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host, HostOptions
from snakesim_hal.host.latch import EstopLatch
from snakesim_hal.model.checked import CHECK, why_unchecked
from snakesim_hal.model.fault_plan import check_without_run
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.local_registry import LocalRobot, registered, robot_folder
from snakesim_hal.network.private_channel import HostEnd
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.stop_port import open_stop_port, serve_stops, stop_address
from snakesim_hal.programs.arguments import add_host
from snakesim_hal.programs.preflight import backend_settings, check_backend, find_backend
from snakesim_hal.programs.service_program import ProcessOptions, connect_process, process_options
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.wire import keys

GONE_LIMIT_S = 3.0  # until the token of a dead host has vanished: longer than the lease of its connection


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code 0 when all ticks were done without a fault, 2 for wrong input, 1 otherwise."""
    parser = argparse.ArgumentParser(
        prog="snakesim start host", description="Run the HAL host of a robot, with its backend."
    )
    add_host(parser)
    arguments = parser.parse_args(argv)
    return run_tool("snakesim start host", lambda: host(process_options(arguments, hosts=True)))


def host(options: ProcessOptions, on_network: Callable[[], None] = lambda: None) -> int:
    """Run a host to its end. Returns 0 when all ticks were done without a fault, 1 otherwise. Raises SnakesimError.

    A simulator that is reset becomes another host, in the same process.

    Args:
        options: of the process.
        on_network: is called once the host can be reached.
    """
    if options.arguments.parent_socket is None:
        check_without_run(options.config, options.loaded.table)
    host = _run(options, check_backend(options.config, options.loaded.table), on_network)
    if host.ended == "reset":
        restart_process()
    stopped = any(fault.reach == "robot" for fault in host.authority.faults_since_start.stored)
    return 1 if stopped or host.ended != "complete" else 0


def _run(options: ProcessOptions, config: RunConfig, on_network: Callable[[], None]) -> Host:
    """Open stop port, backend and network, run the host to its end, and close everything."""
    arguments = options.arguments
    with contextlib.ExitStack() as opened:
        stop_port = _open_stop_port(options, config, opened)
        backend = open_backend(find_backend(config.backend), config)
        opened.callback(backend.close)
        realtime_warnings = enter_realtime(HOST_PRIORITY) if config.clock_mode == "realtime" else []
        network = open_session(options.link) if options.link.listen else connect_process(options.link, "host")
        session = opened.enter_context(network)
        refuse_second_host(session, options.link)
        on_network()
        host = _create_host(arguments, config, backend, session, realtime_warnings)
        serve_stops(stop_port, options.link.namespace or host.description.robot, host.request_estop)
        on_stop_signal(host.stop)
        tune_garbage_collector()
        memory = arguments.memory and os.open(arguments.memory, os.O_WRONLY)
        with HostRecordWriter(
            host.black_box, host.description, partial(create_host_record, host), arguments.out, memory
        ):
            if config.in_host_services:  # imported only for runs with such services
                from snakesim_hal.programs.in_host_service import InHostServices

                opened.enter_context(InHostServices(config, session))
            host.run()
    return host


def _open_stop_port(options: ProcessOptions, config: RunConfig, opened: contextlib.ExitStack) -> socket.socket:
    """Use the stop port that the run has handed to this host, or open one and register the robot on this computer."""
    inherited = options.arguments.stop_port
    if inherited is not None:
        stop_port = socket.socket(fileno=os.dup(inherited))  # the original stays open for another host
    else:
        stop_port = open_stop_port(*stop_address(options.link.endpoint, listens=options.link.listen))
        robot = LocalRobot.describe(options.link, config.robot.name, config.backend, stop_port)
        opened.enter_context(registered(robot))
    opened.callback(stop_port.close)
    return stop_port


def _create_host(
    arguments: argparse.Namespace,
    config: RunConfig,
    backend: GuardedBackend,
    session: Session,
    realtime_warnings: list[str],
) -> Host:
    """Create the HAL host for a backend, with the emergency-stop latch and the cable file of this robot.

    Args:
        arguments: parsed arguments of the host program.
        config: configuration of the run.
        backend: the open backend.
        session: connection to the network.
        realtime_warnings: real-time measures that the system refused, as short reasons.
    """
    described = backend.describe()
    print_stderr(f"host: {describe_what_moves(described)}")  # for a lab's journal too
    unchecked = ""
    if config.controller != CHECK:
        unchecked = why_unchecked(config.robot.checked, config.robot.joint_table, described)
    folder = robot_folder(described.robot, described.backend, described.hardware)
    backend_with_faults, faults = create_host_faults(config, backend, session)
    options = HostOptions(
        # The end of the run.
        max_ticks=round(config.duration_s * config.rate_hz) if arguments.end_after_duration else None,
        end_after_fault_s=arguments.end_after_fault,
        stay=arguments.end_after_fault is None,
        # What connects the host with its surroundings.
        latch=EstopLatch(folder),
        starter=HostEnd.from_descriptor(arguments.parent_socket),
        realtime_warnings=realtime_warnings,
        # The robot.
        faults=faults,
        unchecked=unchecked,
        cables=open_cable_file(folder, config.robot.joint_table, described),
    )
    return Host(config, backend_with_faults, session, options)


def refuse_second_host(session: Session, link: Link) -> None:
    """Raise RefusedError when another HAL host has the robot's name; a dead one may stay visible for a while."""
    deadline = time.monotonic() + GONE_LIMIT_S
    while others := session.present(keys.HOST_ALL):
        if time.monotonic() > deadline:
            raise RefusedError(
                f"another HAL host is on {link.endpoint} as {link.namespace}: "
                f"{keys.parse_service(others[0])}. End it, or "
                f"give this robot another --namespace",
                code="robot/already-running",
            )


def open_backend(backend_type: type[Backend], config: RunConfig) -> GuardedBackend:
    """Open the run's backend. Raises BackendError for any error in it."""
    settings = backend_settings(config, backend_type)
    try:
        return GuardedBackend(backend_type(config, settings))
    except SnakesimError:
        raise
    except (Exception, SystemExit) as error:  # a backend may be third-party code
        raise BackendError(f"backend {config.backend!r} does not open: {type(error).__name__}: {error}") from error


def create_host_record(host: Host, *, lost_ticks: int = 0, failure: str = "") -> HostRecord:
    """Return the host's present statistics.

    This may be called in another thread than the host's loop, which updates each value atomically.
    """
    statistics = host.statistics
    authority = host.authority
    return HostRecord(
        ticks=host.black_box.ticks,
        wall_s=host.wall_s,
        overruns=statistics.overruns,
        answered_ticks=statistics.answered_ticks,
        armed_ticks=statistics.ticks,
        command_digest=host.black_box.command_digest,
        state_to_command_us={f"p{p}": statistics.state_to_command.percentile_us(p) for p in (50, 99)},
        tick_times=statistics.times.timings(),
        rejected_commands=dict(authority.rejected_counts),
        limited_commands=dict(authority.limited_counts),
        faults=list(authority.faults_since_start.stored),
        faults_left_out=authority.faults_since_start.left_out,
        lifecycle=authority.state,
        reason=authority.reason,
        ended=host.ended,
        ended_why=host.ended_why,
        lost_ticks=lost_ticks,
        failure=failure,
        injected=list(host.faults.notes),
        requests=list(host.requests),
        isolated=authority.isolated_joints,
    )


if __name__ == "__main__":
    sys.exit(main())

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

from snakesim_hal.base.process import (
    HOST_PRIORITY,
    call_on_stop_signals,
    enter_realtime,
    make_collections_rare,
    restart_process,
    tune_garbage_collector,
)

if __name__ == "__main__":
    make_collections_rare()

from snakesim_hal.backend import Backend
from snakesim_hal.base.errors import BackendError, RefusedError, SnakesimError
from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.faults.allowed import create_host_faults
from snakesim_hal.host.cable_file import open_cable_file
from snakesim_hal.host.guarded_backend import GuardedBackend
from snakesim_hal.host.host import Host, HostOptions
from snakesim_hal.host.latch import EstopLatch
from snakesim_hal.model.fault_plan import validate_faults_without_supervisor
from snakesim_hal.model.robot_file.checked import START_CHECK_CONTROLLER, find_unchecked_reason
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.local_registry import LocalRobot, get_robot_state_folder, register_robot
from snakesim_hal.network.private_channel import HostEnd
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.stop_port import find_stop_address, open_stop_port, start_stop_server
from snakesim_hal.programs.arguments import add_host_arguments
from snakesim_hal.programs.preflight import (
    decode_backend_settings,
    load_backend_class,
    validate_backend_config,
)
from snakesim_hal.programs.service_program import (
    ProcessOptions,
    connect_process,
    read_process_options,
)
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.wire import keys

# Until the token of a dead host has vanished: longer than the lease of its connection.
TOKEN_EXPIRY_TIMEOUT_S = 3.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program. Return the exit code: 0 after all ticks without a fault, 2 for wrong input, else 1."""
    parser = argparse.ArgumentParser(
        prog="snakesim start host", description="Run the HAL host of a robot, with its backend."
    )
    add_host_arguments(parser)
    arguments = parser.parse_args(argv)
    return run_tool(
        "snakesim start host", lambda: run_host_program(read_process_options(arguments, hosts=True))
    )


def run_host_program(options: ProcessOptions, on_network: Callable[[], None] = lambda: None) -> int:
    """Run a host until it ends, and return the exit code of the process.

    When the simulator is reset, the process restarts as another host.

    Args:
        options: What the process was started with.
        on_network: Function that is called once the host can be reached.

    Returns:
        0 if all ticks were done without a fault, 1 otherwise.

    Raises:
        SnakesimError: The host cannot start or continue.
    """
    if options.arguments.parent_socket is None:
        validate_faults_without_supervisor(options.config, options.loaded.table)
    host = _run_until_end(
        options, validate_backend_config(options.config, options.loaded.table), on_network
    )
    if host.ending_status == "reset":
        restart_process()
    has_stopped = any(fault.scope == "robot" for fault in host.authority.faults_since_start.faults)
    return 1 if has_stopped or host.ending_status != "complete" else 0


def _run_until_end(
    options: ProcessOptions, config: RunConfig, on_network: Callable[[], None]
) -> Host:
    """Open stop port, backend and network, run the host until it ends, and close everything.

    Args:
        options: What the process was started with.
        config: Checked configuration of the run.
        on_network: Function that is called once the host can be reached.

    Returns:
        The host that has ended.
    """
    arguments = options.arguments
    with contextlib.ExitStack() as opened:
        stop_port = _open_stop_port(options, config, opened)
        backend = open_backend(load_backend_class(config.backend), config)
        opened.callback(backend.close)
        realtime_warnings = enter_realtime(HOST_PRIORITY) if config.clock_mode == "realtime" else []
        connection = (
            open_session(options.link)
            if options.link.listen
            else connect_process(options.link, "host")
        )
        session = opened.enter_context(connection)
        refuse_second_host(session, options.link)
        on_network()
        host = _create_host(arguments, config, backend, session, realtime_warnings)
        start_stop_server(
            stop_port, options.link.namespace or host.description.robot, host.request_estop
        )
        call_on_stop_signals(host.request_stop)
        tune_garbage_collector()
        memory_fd: int | None = None
        if arguments.memory:
            memory_fd = os.open(arguments.memory, os.O_WRONLY)
        with HostRecordWriter(
            host.black_box,
            host.description,
            partial(create_host_record, host),
            arguments.out,
            memory_fd,
        ):
            if config.in_host_services:  # imported only for runs with such services
                from snakesim_hal.programs.in_host_service import InHostServices

                opened.enter_context(InHostServices(config, session))
            host.run()
    return host


def _open_stop_port(
    options: ProcessOptions, config: RunConfig, opened: contextlib.ExitStack
) -> socket.socket:
    """Use the stop port that the parent process has passed on, or open one and register the robot on this computer."""
    inherited = options.arguments.stop_port
    if inherited is not None:
        # The original stays open for another host.
        stop_port = socket.socket(fileno=os.dup(inherited))
    else:
        stop_port = open_stop_port(
            *find_stop_address(options.link.endpoint, listens=options.link.listen)
        )
        robot = LocalRobot.from_connection(
            options.link, config.robot.name, config.backend, stop_port
        )
        opened.enter_context(register_robot(robot))
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
        arguments: Parsed arguments of the host program.
        config: Configuration of the run.
        backend: Open backend.
        session: Connection to the network.
        realtime_warnings: Short texts about real-time measures that the operating system refused.
    """
    description = backend.describe()
    print_stderr(f"host: {describe_what_moves(description)}")  # for a lab's journal too
    unchecked_reason = ""
    if config.controller != START_CHECK_CONTROLLER:
        unchecked_reason = find_unchecked_reason(
            config.robot.checked, config.robot.joint_table, description
        )
    folder = get_robot_state_folder(description.robot, description.backend, description.hardware)
    backend_with_faults, faults = create_host_faults(config, backend, session)
    max_ticks: int | None = None
    if arguments.end_after_duration:
        max_ticks = round(config.duration_s * config.rate_hz)
    options = HostOptions(
        # The end of the run.
        max_ticks=max_ticks,
        end_after_fault_s=arguments.end_after_fault,
        stays_after_run=arguments.end_after_fault is None,
        # What connects the host with its surroundings.
        latch=EstopLatch(folder),
        starter_channel=HostEnd.from_descriptor(arguments.parent_socket),
        realtime_warnings=realtime_warnings,
        # The robot.
        faults=faults,
        unchecked_reason=unchecked_reason,
        cable_file=open_cable_file(folder, config.robot.joint_table, description),
    )
    return Host(config, backend_with_faults, session, options)


def refuse_second_host(session: Session, connection: ConnectionSettings) -> None:
    """Raise RefusedError if another HAL host has the robot's name. A dead host stays visible for a while."""
    deadline = time.monotonic() + TOKEN_EXPIRY_TIMEOUT_S
    while other_hosts := session.list_tokens(keys.HOST_ALL):
        if time.monotonic() > deadline:
            raise RefusedError(
                f"another HAL host is on {connection.endpoint} as {connection.namespace}: "
                f"{keys.parse_service(other_hosts[0])}. End it, or "
                f"give this robot another --namespace",
                code="robot/already-running",
            )


def open_backend(backend_type: type[Backend], config: RunConfig) -> GuardedBackend:
    """Open the run's backend. Raises BackendError for any error that is not a SnakesimError itself."""
    settings = decode_backend_settings(config, backend_type)
    try:
        return GuardedBackend(backend_type(config, settings))
    except SnakesimError:
        raise
    except (Exception, SystemExit) as error:  # a backend may be third-party code
        raise BackendError(
            f"backend {config.backend!r} does not open: {type(error).__name__}: {error}"
        ) from error


def create_host_record(host: Host, *, lost_ticks: int = 0, failure: str = "") -> HostRecord:
    """Return the current statistics of a host.

    This may be called in another thread than the host's loop, which updates each value atomically.

    Args:
        host: Host, which may be running.
        lost_ticks: Number of ticks that are missing in the black box file.
        failure: Which file cannot be written, and why. Empty if all can be written.
    """
    statistics = host.statistics
    authority = host.authority
    return HostRecord(
        ticks=host.black_box.row_count,
        wall_s=host.armed_wall_time_s,
        overruns=statistics.overruns,
        answered_ticks=statistics.answered_ticks,
        armed_ticks=statistics.ticks,
        command_digest=host.black_box.command_digest,
        state_to_command_us={
            f"p{p}": statistics.state_to_command.percentile_us(p) for p in (50, 99)
        },
        tick_times=statistics.times.timings(),
        rejected_commands=dict(authority.rejected_counts),
        limited_commands=dict(authority.limited_counts),
        faults=list(authority.faults_since_start.faults),
        faults_left_out=authority.faults_since_start.dropped_count,
        lifecycle=authority.state,
        reason=authority.reason,
        ended=host.ending_status,
        ending_reason=host.ending_reason,
        lost_ticks=lost_ticks,
        failure=failure,
        injected=list(host.faults.notes),
        requests=list(host.request_log),
        isolated=authority.isolated_joints,
    )


if __name__ == "__main__":
    sys.exit(main())

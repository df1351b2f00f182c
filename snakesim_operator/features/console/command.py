"""`snakesim console`, and the process that `snakesim run --console` starts."""

import argparse
import contextlib
import socket
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.process import call_on_stop_signals, raise_open_file_limit
from snakesim_hal.base.terminal import print_line
from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import read_config
from snakesim_hal.network.local_registry import list_local_robots
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.programs.arguments import (
    add_network_arguments,
    add_parent_argument,
    add_scenario_arguments,
)
from snakesim_hal.programs.service_program import read_process_options
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import ConsolePorts, open_console_ports
from snakesim_operator.base.targets import RobotSelection, find_single_robot
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.console_front import start_console_front

MAX_OPEN_FILES = 4096  # far more than connections of browsers may use


def show_live_robot(
    selection: RobotSelection, port: int | None, robot_file: Path | None = None
) -> int:
    """Show a running robot in the browser, on pages that can also control it, until Ctrl-C.

    Args:
        selection: Selects the robot.
        port: Port of the page; None for the default port, or any free one.
        robot_file: The robot file into which pages may write measured values; None if they may write no file.

    Returns:
        The exit code.

    Raises:
        NotConnectedError: There is no such robot.
        ConfigError: An extra is missing, or the robot file is not valid.
    """
    _prepare_process()
    if robot_file is not None:
        extras.require_extra("lab", "commissioning")
        robot_text = read_table_with_base(str(robot_file), "robots")
        # An invalid file is an error now, rather than when a page writes it.
        decode_table(robot_text, RobotFile)
    from snakesim_operator.features.console.display_loop import run_live_display

    link = find_single_robot(selection, "console")
    stop_event = _make_stop_event()
    with _run_front_server(port, link, stop_event) as ports:
        run_live_display(
            link, _find_surroundings(link), ports.page_socket, stop_event, robot_file=robot_file
        )
    return 0


def show_recorded_run(folder: Path, at_s: float, port: int | None) -> int:
    """Show a recorded run in the browser, with controls to play and to jump, until Ctrl-C.

    Args:
        folder: The folder of the run.
        at_s: Time to show first, in seconds after the first instant.
        port: Port of the page; None for the default port, or any free one.

    Returns:
        The exit code.

    Raises:
        ConfigError: The folder is not one of a run.
    """
    _prepare_process()
    from snakesim_operator.features.console.display_loop import run_recording_display
    from snakesim_operator.features.console.robot_data.run_playback import RunPlayback

    run = RunPlayback(folder)
    stop_event = _make_stop_event()
    with _run_front_server(port, None, stop_event) as ports:
        return run_recording_display(run, at_s, ports.page_socket, stop_event)


def main(argv: Sequence[str] | None = None) -> int:
    """Serve the pages of the run that started this process, at a socket that the run has opened.

    The process ends with the run.

    Args:
        argv: Arguments of the command line; None for those of this process.

    Returns:
        The exit code, which is always 0.
    """
    parser = argparse.ArgumentParser(
        prog="snakesim_operator.features.console", description="Show a run in the browser."
    )
    add_scenario_arguments(parser)
    add_network_arguments(parser, "")
    add_parent_argument(parser)
    # Inherited descriptor.
    parser.add_argument("--listening", type=int, required=True, help=argparse.SUPPRESS)
    options = read_process_options(parser.parse_args(argv))
    _prepare_process()
    from snakesim_operator.features.console.display_loop import run_live_display
    from snakesim_operator.features.console.robot_data.snapshot import make_expected_snapshot
    from snakesim_operator.features.console.scene.drawing import TrueSurroundings

    listening_socket = socket.socket(fileno=options.arguments.listening)
    expected = make_expected_snapshot(options.config)
    run_live_display(
        options.link,
        TrueSurroundings(options.config),
        listening_socket,
        _make_stop_event(),
        expected,
    )
    return 0


def _prepare_process() -> None:
    """Check that the console can run, and raise the limit of open files, which a stop needs too.

    Modules that need the extra can be imported only after this.
    """
    extras.require_extra("console", "the console")
    raise_open_file_limit(MAX_OPEN_FILES)


@contextlib.contextmanager
def _run_front_server(
    port: int | None, connection: ConnectionSettings | None, stop_event: threading.Event
) -> Iterator[ConsolePorts]:
    """Run the front server as a child process for the duration of a `with` block, and print the page's address.

    Args:
        port: Port of the page; None for the default port, or any free one.
        connection: Addresses with which the robot is reached; None for a recording.
        stop_event: Set when the front server ends, because the pages cannot be reached then.

    Raises:
        NotConnectedError: The port is in use, or the front server has ended.
    """
    with open_console_ports(port) as ports:
        front = start_console_front(
            ports, connection, lambda output: print_line(output.decode(errors="replace").rstrip())
        )
        print_line(f"console: {ports.address}")
        ports.browser_socket.close()  # the front server has its own copy
        start_restarting_thread("console front watch", partial(_set_after_exit, front, stop_event))
        try:
            yield ports
            end_reason = front.describe_exit()
        finally:
            children.stop_children([front])
            if front.was_killed:
                print_line(f"warning: {front.describe_exit()}")
    if end_reason is not None:
        raise NotConnectedError(f"no browser can connect any more: {end_reason}")


def _set_after_exit(child: children.ChildProcess, event: threading.Event) -> None:
    """Set an event once a child has ended."""
    child.process.wait()
    event.set()


def _find_surroundings(connection: ConnectionSettings):
    """Return the true surroundings of a robot that runs on this computer, from its configuration; None for others."""
    from snakesim_operator.features.console.scene.drawing import TrueSurroundings

    for robot in list_local_robots():
        is_same_robot = (robot.endpoint, robot.namespace) == (
            connection.endpoint,
            connection.namespace,
        )
        if is_same_robot and robot.config is not None:
            try:
                return TrueSurroundings(read_config(Path(robot.config)))
            except (ConfigError, OSError):
                return None
    return None


def _make_stop_event() -> threading.Event:
    """Return an event that is set when this process gets a signal to stop."""
    stop = threading.Event()
    call_on_stop_signals(stop.set)
    return stop

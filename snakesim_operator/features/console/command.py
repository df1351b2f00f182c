"""`snakesim console`, and the process that `snakesim run --console` starts."""

import argparse
import contextlib
import socket
import threading
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.process import on_stop_signal, raise_open_files
from snakesim_hal.base.terminal import print_line
from snakesim_hal.base.workers import start_worker
from snakesim_hal.model.files import decode, read_part
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import read_config
from snakesim_hal.network.local_registry import local_robots
from snakesim_hal.network.session import Link
from snakesim_hal.programs.arguments import add_network, add_parent, add_scenario
from snakesim_hal.programs.service_program import process_options
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import ConsolePorts, open_console_ports
from snakesim_operator.base.targets import RobotSelection, only_robot
from snakesim_operator.run import children
from snakesim_operator.run.console_front import start_front

MAX_OPEN_FILES = 4096  # far more than connections of browsers may use


def console(where: RobotSelection, port: int | None, commission: Path | None = None) -> int:
    """Show a running robot until Ctrl-C.

    Args:
        where: Selects the robot.
        port: Port of the page; None: the default port, or any free one.
        commission: The robot file, into which pages may write what was found by hand; None: pages write no file.

    Returns:
        The exit code.

    Raises:
        NotConnectedError: There is no such robot.
        ConfigError: An extra is missing, or the robot file is not valid.
    """
    _prepare_process()
    if commission is not None:
        extras.require("lab", "commissioning")
        robot_text = read_part(str(commission), "robots")
        decode(robot_text, RobotFile)  # an invalid file is an error now, rather than when a page writes it
    from snakesim_operator.features.console.display_loop import show_live

    link = only_robot(where, "console")
    stop = _stop_on_signal()
    with _front_server(port, link, stop) as ports:
        show_live(link, _find_surroundings(link), ports.pages, stop, commission=commission)
    return 0


def show_record(folder: Path, at_s: float, port: int | None) -> int:
    """Show a recorded run until Ctrl-C.

    Args:
        folder: The folder of the run.
        at_s: Where to begin, in seconds after the first instant.
        port: Port of the page; None: the default port, or any free one.

    Returns:
        The exit code.

    Raises:
        ConfigError: The folder is not one of a run.
    """
    _prepare_process()
    from snakesim_operator.features.console.display_loop import show_recorded
    from snakesim_operator.features.console.robot_data.run_playback import RunPlayback

    run = RunPlayback(folder)
    stop = _stop_on_signal()
    with _front_server(port, None, stop) as ports:
        return show_recorded(run, at_s, ports.pages, stop)


def main(argv: Sequence[str] | None = None) -> int:
    """Serve the pages of the run that started this process, at a socket that the run has opened.

    The process ends with the run.
    """
    parser = argparse.ArgumentParser(
        prog="snakesim_operator.features.console", description="Show a run in the browser."
    )
    add_scenario(parser)
    add_network(parser, "")
    add_parent(parser)
    parser.add_argument("--listening", type=int, required=True, help=argparse.SUPPRESS)  # inherited descriptor
    options = process_options(parser.parse_args(argv))
    _prepare_process()
    from snakesim_operator.features.console.display_loop import show_live
    from snakesim_operator.features.console.robot_data.snapshot import make_expected_snapshot
    from snakesim_operator.features.console.scene.drawing import Surroundings

    listening = socket.socket(fileno=options.arguments.listening)
    expected = make_expected_snapshot(options.config)
    show_live(options.link, Surroundings(options.config), listening, _stop_on_signal(), expected)
    return 0


def _prepare_process() -> None:
    """Check that the console can run, and raise the limit of open files, which a stop needs too.

    Modules that need the extra can be imported only after this.
    """
    extras.require("console", "the console")
    raise_open_files(MAX_OPEN_FILES)


@contextlib.contextmanager
def _front_server(port: int | None, link: Link | None, stop: threading.Event) -> Iterator[ConsolePorts]:
    """Run the front server in a process of its own, and print the address of the page.

    Args:
        port: Port of the page; None: the default port, or any free one.
        link: How to reach the robot; None for a recording.
        stop: Set when the front server ends, because the pages cannot be reached then.

    Raises:
        NotConnectedError: The port is in use, or the front server has ended.
    """
    with open_console_ports(port) as ports:
        front = start_front(ports, link, lambda output: print_line(output.decode(errors="replace").rstrip()))
        print_line(f"console: {ports.address}")
        ports.browsers.close()  # the front server has its own copy
        start_worker("console front watch", partial(_set_after_end, front, stop))
        try:
            yield ports
            end = front.describe_end()
        finally:
            children.stop_all([front])
            if front.was_killed:
                print_line(f"warning: {front.describe_end()}")
    if end is not None:
        raise NotConnectedError(f"no browser can connect any more: {end}")


def _set_after_end(child: children.Child, event: threading.Event) -> None:
    """Set an event once a child has ended."""
    child.process.wait()
    event.set()


def _find_surroundings(link: Link):
    """Return the true surroundings of a robot that runs on this computer, from its configuration; None for others."""
    from snakesim_operator.features.console.scene.drawing import Surroundings

    for robot in local_robots():
        is_same_robot = (robot.endpoint, robot.namespace) == (link.endpoint, link.namespace)
        if is_same_robot and robot.config is not None:
            try:
                return Surroundings(read_config(Path(robot.config)))
            except (ConfigError, OSError):
                return None
    return None


def _stop_on_signal() -> threading.Event:
    """Return an event that is set when this process gets a signal to stop."""
    stop = threading.Event()
    on_stop_signal(stop.set)
    return stop

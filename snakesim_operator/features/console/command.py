"""`snakesim console`, and the process that `snakesim run --console` starts."""

import argparse
import socket
import threading
from collections.abc import Sequence
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import on_stop_signal, raise_open_files
from snakesim_hal.model.files import decode, read_part
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import read
from snakesim_hal.network.local_registry import local_robots
from snakesim_hal.network.session import Link
from snakesim_hal.programs.arguments import add_network, add_parent, add_scenario
from snakesim_hal.programs.service_program import process_options
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import open_port
from snakesim_operator.base.targets import RobotSelection, only_robot

MAX_OPEN_FILES = 4096  # connections of browsers take few of them; see `connections.ConnectionLimits`


def console(where: RobotSelection, port: int | None, commission: Path | None = None) -> int:
    """Show a running robot until Ctrl-C. Raises NotConnectedError when there is none, ConfigError.

    commission: its robot file, into which pages may write what was found by hand.
    """
    extras.check("console", "the console")
    if commission is not None:
        extras.check("commission", "commissioning")
        decode(read_part(str(commission), "robots"), RobotFile)
    raise_open_files(MAX_OPEN_FILES)
    from snakesim_operator.features.console.display_loop import show_live

    link = only_robot(where, "console")
    show_live(link, _surroundings(link), open_port(port), _until_signal(), commission=commission)
    return 0


def show_record(folder: Path, at_s: float, port: int | None) -> int:
    """Show a recorded run until Ctrl-C. Raises ConfigError when the folder is not one of a run."""
    extras.check("console", "the console")
    raise_open_files(MAX_OPEN_FILES)
    from snakesim_operator.features.console.display_loop import show_recorded

    return show_recorded(folder, at_s, open_port(port), _until_signal())


def _surroundings(link: Link):
    """The true surroundings of a robot that runs on this computer, by its run's configuration; else None."""
    from snakesim_operator.features.console.scene.drawing import Surroundings

    for robot in local_robots():
        if (robot.endpoint, robot.namespace) == (link.endpoint, link.namespace) and robot.config is not None:
            try:
                return Surroundings(read(Path(robot.config)))
            except (ConfigError, OSError):
                return None
    return None


def _until_signal() -> threading.Event:
    stop = threading.Event()
    on_stop_signal(stop.set)
    return stop


def main(argv: Sequence[str] | None = None) -> int:
    """The console of a run, as a child that dies with it, on a port that the run has opened."""
    parser = argparse.ArgumentParser(
        prog="snakesim_operator.features.console", description="Show a run in the browser."
    )
    add_scenario(parser)
    add_network(parser, "")
    add_parent(parser)
    parser.add_argument("--listening", type=int, required=True, help=argparse.SUPPRESS)  # inherited socket
    given = process_options(parser.parse_args(argv))
    extras.check("console", "the console")
    raise_open_files(MAX_OPEN_FILES)
    from snakesim_operator.features.console.display_loop import show_live
    from snakesim_operator.features.console.robot_data.snapshot import expected_snapshot
    from snakesim_operator.features.console.scene.drawing import Surroundings

    listening = socket.socket(fileno=given.arguments.listening)
    expected = expected_snapshot(given.config)
    show_live(given.link, Surroundings(given.config), listening, _until_signal(), expected)
    return 0

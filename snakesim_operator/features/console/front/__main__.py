"""The program of the front server: `python -m snakesim_operator.features.console.front`. The console starts it."""

import argparse
import asyncio
import os
import socket
import sys
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from snakesim_hal.base.process import (
    call_on_stop_signals,
    raise_open_file_limit,
    set_parent_death_signal,
)
from snakesim_hal.base.terminal import print_line, run_tool
from snakesim_hal.base.workers import start_restarting_thread
from snakesim_hal.network.endpoint import DEFAULT_ENDPOINT
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.programs.arguments import (
    add_network_arguments,
    add_parent_argument,
    read_session_option,
)
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_operator.base.console_port import TOKEN_VARIABLE
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.features.console.front.front_server import FrontServer
from snakesim_operator.robot_commands.prepared_stop import PreparedStop

MAX_OPEN_FILES = 4096  # far more than the limits of the front server allow


def main(argv: Sequence[str] | None = None) -> int:
    """Run the front server until a signal ends it, or its parent ends. Returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="snakesim_operator.features.console.front",
        description="Accept browsers, and stop the robot.",
    )
    parser.add_argument(
        "--browsers", type=int, required=True, help="inherited descriptor of the listening socket"
    )
    parser.add_argument("--pages", type=Path, required=True, help="Unix socket of the page server")
    parser.add_argument(
        "--recording", action="store_true", help="there is no robot that can be stopped"
    )
    add_network_arguments(parser, "")
    add_parent_argument(parser)
    return run_tool("snakesim console", partial(_run, parser.parse_args(argv)))


def _run(arguments: argparse.Namespace) -> int:
    if arguments.parent is not None:
        set_parent_death_signal(arguments.parent)
    raise_open_file_limit(MAX_OPEN_FILES)
    stop = None if arguments.recording else _prepare_stop(arguments)
    listening = socket.socket(fileno=arguments.browsers)
    server = FrontServer(listening, arguments.pages, os.environ[TOKEN_VARIABLE], stop, print_line)
    asyncio.run(_serve_until_signal(server))
    return 0


async def _serve_until_signal(server: FrontServer) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    def end() -> None:
        loop.call_soon_threadsafe(ended.set)

    call_on_stop_signals(end)
    await server.run(ended)


def _prepare_stop(arguments: argparse.Namespace) -> PreparedStop:
    """Open what a stop needs. The network session follows in a thread of its own, once the robot's network answers."""
    session = read_session_option(arguments)
    if session is not None:
        link = ConnectionSettings.from_session_file(session, arguments.namespace)
    else:
        link = ConnectionSettings(
            arguments.router or arguments.endpoint or DEFAULT_ENDPOINT, arguments.namespace
        )
    selection = RobotSelection(link.endpoint, link.namespace, link.session)
    stop = PreparedStop(
        selection, link, lambda requester, result: print_line(f"{requester}: {result}")
    )
    start_restarting_thread("stop session", partial(_keep_session, stop, link))
    return stop


def _keep_session(stop: PreparedStop, connection: ConnectionSettings) -> None:
    """Give the stop a network session, for as long as this process lives."""
    with open_session(connection, SERVICE_START_LIMIT_S) as session:
        stop.use_session(session)
        threading.Event().wait()


if __name__ == "__main__":
    sys.exit(main())

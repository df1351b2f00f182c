"""Starts the front server of a console, the process that browsers connect to."""

from collections.abc import Callable

from snakesim_hal.network.session import ConnectionSettings
from snakesim_operator.base.console_port import TOKEN_VARIABLE, ConsolePorts
from snakesim_operator.run.processes import children

FRONT_MODULE = "snakesim_operator.features.console.front"


def start_console_front(
    ports: ConsolePorts, connection: ConnectionSettings | None, on_output: Callable[[bytes], object]
) -> children.ChildProcess:
    """Start the front server of a console as a child process.

    Args:
        ports: Sockets of the console, and the path of the page server.
        connection: Connection to the robot that its stop button stops; None for a recording.
        on_output: Called with each piece of output of the server, in another thread.
    """
    browsers_fd = ports.browser_socket.fileno()
    arguments = [
        FRONT_MODULE,
        "--browsers",
        str(browsers_fd),
        "--pages",
        str(ports.page_socket_path),
        *_make_robot_arguments(connection),
    ]
    token = {TOKEN_VARIABLE: ports.token}
    return children.start_child(
        "console front", arguments, on_output, pass_fds=[browsers_fd], extra_env=token
    )


def _make_robot_arguments(connection: ConnectionSettings | None) -> list[str]:
    """Return the command-line arguments by which the front server finds the robot."""
    if connection is None:
        return ["--recording"]
    robot = [] if connection.namespace is None else ["--namespace", connection.namespace]
    if connection.session is not None:
        return ["--session", str(connection.session.path), *robot]
    return ["--endpoint", connection.endpoint, *robot]

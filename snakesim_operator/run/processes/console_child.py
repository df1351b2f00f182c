"""The console of a run: two child processes that end with the run. If the console fails, the run is not disturbed."""

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.session import ConnectionSettings
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import open_console_ports
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.console_front import start_console_front
from snakesim_operator.run.run_files import RunFiles

CONSOLE_MODULE = "snakesim_operator.features.console"
LOG_FILENAME = "console.log"  # in the folder of the run


def require_console() -> None:
    """Raise ConfigError if the console or a package that it needs is not installed."""
    if importlib.util.find_spec(CONSOLE_MODULE) is None:
        raise ConfigError(
            "--console: this installation is one without the console; leave it out",
            code="extra/not-installed",
        )
    extras.require_extra("console", "--console", "; or leave it out")


@contextlib.contextmanager
def run_console(
    common_arguments: Sequence[str],
    connection: ConnectionSettings,
    files: RunFiles,
    report: Callable[[str], None],
) -> Iterator[None]:
    """Run the console in two child processes, the front process and the page server, while the context is active.

    Args:
        common_arguments: Command-line arguments of every process of the run, such as its scenario and endpoint.
        connection: Connection of the console to the robot.
        files: Files of the run, which receive the output of the console.
        report: Called with the address of the page, and with warnings.
    """
    on_output = partial(files.append, LOG_FILENAME)
    with open_console_ports(port=None) as ports:
        front_process = start_console_front(ports, connection, on_output)
        pages_fd = ports.page_socket.fileno()
        arguments = [CONSOLE_MODULE, *common_arguments, "--listening", str(pages_fd)]
        page_server_process = children.start_child(
            "console", arguments, on_output, pass_fds=[pages_fd]
        )
        report(f"console: {ports.address}")
        # This process closes its copies: if the console ends, browsers then lose their connection at once.
        ports.close()
        try:
            yield
        finally:
            children.stop_children([page_server_process, front_process])
            for child in (page_server_process, front_process):
                if child.was_killed:
                    report(f"warning: {child.describe_exit()}")

"""The console of a run: two child processes that end with the run. If the console fails, the run is not disturbed."""

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.network.session import Link
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import open_console_ports
from snakesim_operator.run import children
from snakesim_operator.run.console_front import start_front
from snakesim_operator.run.run_files import RunFiles

CONSOLE = "snakesim_operator.features.console"
LOG = "console.log"  # in the folder of the run


def check_console() -> None:
    """Check that the console and the packages that it needs are installed. Raises ConfigError if they are not."""
    if importlib.util.find_spec(CONSOLE) is None:
        raise ConfigError(
            "--console: this installation is one without the console; leave it out", code="extra/not-installed"
        )
    extras.require("console", "--console", "; or leave it out")


@contextlib.contextmanager
def console_beside(common: Sequence[str], link: Link, files: RunFiles, report: Callable[[str], None]) -> Iterator[None]:
    """Run the console for as long as the context lives.

    Args:
        common: arguments that every process of the run gets, such as its scenario and endpoint.
        link: how the console reaches the robot.
        files: get what the console prints.
        report: gets the address of the page.
    """
    keep = partial(files.append, LOG)
    with open_console_ports(None) as ports:
        front = start_front(ports, link, keep)
        handle = ports.pages.fileno()
        arguments = [CONSOLE, *common, "--listening", str(handle)]
        pages = children.start_child("console", arguments, keep, inherits=[handle])
        report(f"console: {ports.address}")
        # This process closes its copies: if the console ends, browsers then lose their connection at once.
        ports.close()
        try:
            yield
        finally:
            children.stop_all([pages, front])
            for child in (pages, front):
                if child.was_killed:
                    report(f"warning: {child.describe_end()}")

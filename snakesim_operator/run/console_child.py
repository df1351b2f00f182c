"""The console of a run: a child process that ends with the run. If the console fails, the run is not disturbed."""

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.base import extras
from snakesim_operator.base.console_port import open_port, page_address
from snakesim_operator.run import children
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
def console_beside(common: Sequence[str], files: RunFiles, report: Callable[[str], None]) -> Iterator[None]:
    """Run the console for as long as the context lives.

    Args:
        common: arguments that every process of the run gets, such as its scenario and endpoint.
        files: get what the console prints.
        report: gets the address of the page.
    """
    # This process closes the port again: if the console ends, browsers then lose their connection at once.
    with open_port(None) as listening:
        handle = listening.fileno()
        arguments = [CONSOLE, *common, "--listening", str(handle)]
        child = children.start_child("console", arguments, partial(files.append, LOG), inherits=[handle])
        report(f"console: {page_address(listening)}")
    try:
        yield
    finally:
        children.stop_all([child])

"""The console beside a run: a child process that dies with it, and that the run does not depend on."""

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
LOG = "console.log"


def check_console() -> None:
    """Raise ConfigError when the console, or what it needs, is not installed."""
    if importlib.util.find_spec(CONSOLE) is None:
        raise ConfigError(
            "--console: this installation is one without the console; leave it out", code="extra/not-installed"
        )
    extras.require("console", "--console", "; or leave it out")


@contextlib.contextmanager
def console_beside(common: Sequence[str], files: RunFiles, say: Callable[[str], None]) -> Iterator[None]:
    """Show the run in the browser for as long as the context lives. common: the arguments of each of its processes."""
    with open_port(None) as listening:  # only the console keeps it open: when that has ended, browsers are told at once
        handle = listening.fileno()
        arguments = [CONSOLE, *common, "--listening", str(handle)]
        child = children.start_child("console", arguments, partial(files.append, LOG), inherits=[handle])
        say(f"console: {page_address(listening)}")
    try:
        yield
    finally:
        children.stop_all([child])

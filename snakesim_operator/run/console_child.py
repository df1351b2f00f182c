"""The console beside a run: a child process that dies with it, and that the run does not depend on."""

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence

from snakesim_hal.errors import ConfigError
from snakesim_operator.run import children
from snakesim_operator.run.run_files import RunFiles

LOG = "console.log"
ADDRESS = b"console: http"


def check_console() -> None:
    """Raise ConfigError when the console is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise ConfigError("--console needs viser; install it with: pip install 'snakesim[console]', or leave it out")


@contextlib.contextmanager
def console_beside(common: Sequence[str], files: RunFiles, say: Callable[[str], None]) -> Iterator[None]:
    """Show the run in the browser for as long as the context lives. common: the arguments of each of its processes."""
    told = False

    def keep(words: bytes) -> None:
        nonlocal told
        files.append(LOG, words)
        for line in words.splitlines():
            if line.startswith(ADDRESS) and not told:
                told = True
                say(line.decode(errors="replace"))

    child = children.start("console", ["snakesim_operator.console", *common], keep)
    try:
        yield
    finally:
        children.stop_all([child])

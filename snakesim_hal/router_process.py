"""`python -m snakesim_hal.router_process`: a router for one run, for tests of router failures."""

import sys
import threading
from collections.abc import Sequence
from dataclasses import replace

from snakesim_hal.errors import SnakesimError
from snakesim_hal.network.session import open_session
from snakesim_hal.process import on_stop_signal
from snakesim_hal.serve import arguments, process_options
from snakesim_hal.terminal import complain_of


def main(argv: Sequence[str] | None = None) -> int:
    """Forward between all connected sessions, until a stop signal."""
    given = process_options(arguments("Run a Zenoh router on a run's endpoint."), argv, listen=True)
    stopped = threading.Event()
    on_stop_signal(stopped.set)
    try:
        with open_session(replace(given.link, namespace=None)):
            stopped.wait()
    except SnakesimError as error:
        complain_of(error, "snakesim router")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

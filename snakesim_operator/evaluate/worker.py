"""Loaded into each worker process of this computer as it starts."""

import os
import signal
from typing import Any

from snakesim_hal.process import die_with_parent

NICE = 10  # whoever watches a run meanwhile comes first


def dask_setup(_worker: Any) -> None:
    """Called by Dask. The kernel kills this process when the evaluation dies, even if it is frozen then."""
    die_with_parent()
    os.nice(max(NICE - os.nice(0), 0))  # a command under `nice` is not sent further back
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the evaluation

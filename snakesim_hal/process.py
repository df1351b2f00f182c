"""Processes that never outlive what started them, and that stop in order when asked to."""

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

PR_SET_PDEATHSIG = 1
REALTIME_PRIORITY = 20  # of 99; above every ordinary process, below the kernel's own threads


def die_with_parent(parent_pid: int | None = None) -> None:
    """Have the kernel kill this process the moment its parent dies, however it dies.

    parent_pid: the parent as the parent itself knows it; when it is gone already, exit at once.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if parent_pid is not None and os.getppid() != parent_pid:
        sys.exit(1)


def on_stop_signal(stop: Callable[[], None]) -> None:
    """Call `stop` on SIGTERM and SIGINT instead of dying in the middle of something."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop()

    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)


def settle_for_timing() -> None:
    """Keep the garbage collector out of the loop: what lives now is frozen, and collections become rare."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 50, 1000)


def take_priority() -> None:
    """Ask the kernel to run this process, and the threads that it will start, before ordinary ones.

    Best effort: where it is refused the process says so and goes on. Call it before the session is opened.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
    except OSError as error:
        print(f"running without real-time priority: {error.strerror}; see `ulimit -r`", file=sys.stderr)

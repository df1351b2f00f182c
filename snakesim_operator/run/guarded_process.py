"""A run in one process as a child of its command, which ends the child whatever its code does.

Python runs a signal's handler between two steps of Python code. If a controller computes in compiled code without end,
as a model with a loop may, the process does not react to Ctrl-C. So the command forks before anything large is loaded:
the child does the run, and the command waits, forwards signals, and kills a child that does not react.
"""

import os
import select
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from snakesim_hal.base.process import die_with_parent, limit_memory, stop_signals
from snakesim_hal.base.step_limit import SharedStepTimes
from snakesim_hal.base.terminal import print_stderr

CHECK_PERIOD_S = 0.25
INTERRUPT_LIMIT_S = 3.0  # for the present step, after Ctrl-C; Python code is interrupted long before
OVERDUE_LIMIT_S = 5.0  # for a step that is due; Python code is interrupted long before
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130  # as shells report a program that Ctrl-C has ended
RECORD_HINT = "What was recorded until then is in the run's folder; `snakesim recording report FOLDER` shows it"


def run_guarded(act: Callable[[SharedStepTimes | None], int], *, owns_process: bool) -> int:
    """Call a function in a child process, which this process can end whatever the function does.

    Args:
        act: the function; gets the step times by which it shows its progress, and returns an exit code.
        owns_process: whether this process does nothing else. If it does, it must not be forked, and the function is
            called in this process, without step times.

    Returns:
        The exit code of the command.
    """
    if not owns_process:
        return act(None)
    sys.stdout.flush()
    sys.stderr.flush()
    step_times = SharedStepTimes()
    command = os.getpid()
    child = os.fork()
    if child != 0:
        return _Guard(child, step_times).wait()
    os.setsid()  # Ctrl-C then reaches the command alone, which forwards it
    die_with_parent(command)
    limit_memory()
    return act(step_times)


class _Guard:
    """Waits for the child in the process of the command, forwards signals to it, and kills it if it does not react."""

    def __init__(self, child: int, step_times: SharedStepTimes) -> None:
        self._child = child
        self._step_times = step_times
        self._signalled_s: float | None = None
        self._handle = os.pidfd_open(child)
        for number in stop_signals():
            signal.signal(number, self._forward_signal)

    def wait(self) -> int:
        """Wait until the child has ended, and return the exit code of the command."""
        kill_reason = ""
        while not self._has_ended():
            if kill_reason:
                continue
            kill_reason = self._find_kill_reason()
            if kill_reason:
                os.kill(self._child, signal.SIGKILL)
        _, wait_status = os.waitpid(self._child, 0)
        code = os.waitstatus_to_exitcode(wait_status)
        was_killed = code < 0  # minus the number of the signal that ended it
        if kill_reason:
            print_stderr(f"snakesim: {kill_reason}; its process was killed. {RECORD_HINT}")
        if not was_killed:
            return code
        if self._signalled_s is not None:
            return EXIT_INTERRUPTED
        if not kill_reason:
            print_stderr(f"snakesim: {_describe_end(-code)}. {RECORD_HINT}")
        return EXIT_FAILED

    def _has_ended(self) -> bool:
        """Wait CHECK_PERIOD_S at most, and return whether the child has ended."""
        readable, _, _ = select.select([self._handle], [], [], CHECK_PERIOD_S)
        return bool(readable)

    def _forward_signal(self, number: int, _frame: FrameType | None) -> None:
        """Forward the first signal to the child; kill the child at another one."""
        if self._signalled_s is None:
            self._signalled_s = time.monotonic()
            os.kill(self._child, number)
        elif number != signal.SIGHUP:  # the kernel and the shell both send one
            os.kill(self._child, signal.SIGKILL)

    def _find_kill_reason(self) -> str:
        """Return why the child is to be killed; empty while it makes progress."""
        step_s = self._step_times.read_step_times()
        if step_s is None:
            return ""
        began_s, due_s = step_s
        now_s = time.monotonic()
        if now_s > due_s + OVERDUE_LIMIT_S:
            return f"one step of the run took longer than {due_s - began_s:g} s, in compiled code"
        signalled_s = self._signalled_s
        if signalled_s is not None and began_s <= signalled_s < now_s - INTERRUPT_LIMIT_S:
            return f"one step of the run had not returned {INTERRUPT_LIMIT_S:g} s after it received the signal to stop"
        return ""


def _describe_end(number: int) -> str:
    """Return how a signal ended the child, as a clause."""
    if number == signal.SIGKILL:
        return "the process of the run was killed, perhaps for lack of memory"
    return f"the process of the run was ended by {signal.Signals(number).name}"

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

from snakesim_hal.base.process import limit_memory, list_stop_signals, set_parent_death_signal
from snakesim_hal.base.step_limit import SharedStepTimes
from snakesim_hal.base.terminal import print_stderr

CHECK_PERIOD_S = 0.25
# For the current step, after Ctrl-C; Python code is interrupted long before.
INTERRUPT_TIMEOUT_S = 3.0
OVERDUE_TIMEOUT_S = 5.0  # for a step that is due; Python code is interrupted long before
EXIT_FAILED = 1
EXIT_INTERRUPTED = 130  # as shells report a program that Ctrl-C has ended
RECORD_HINT = "What was recorded until then is in the run's folder; `snakesim recording report FOLDER` shows it"


def run_in_guarded_child(
    function: Callable[[SharedStepTimes | None], int], *, owns_process: bool
) -> int:
    """Call a function in a child process, which this process can end even if the function hangs.

    Args:
        function: Function to call; it gets the shared step times that show its progress, and returns an exit code.
        owns_process: Whether this process does nothing else. A process with other work must not be forked, so the
            function is called in this process, without step times.

    Returns:
        The exit code of the command.
    """
    if not owns_process:
        return function(None)
    sys.stdout.flush()
    sys.stderr.flush()
    step_times = SharedStepTimes()
    parent_pid = os.getpid()
    child_pid = os.fork()
    if child_pid != 0:
        return _ChildGuard(child_pid, step_times).wait_for_exit()
    os.setsid()  # Ctrl-C then reaches the command alone, which forwards it
    set_parent_death_signal(parent_pid)
    limit_memory()
    return function(step_times)


class _ChildGuard:
    """Waits for the child in the process of the command, forwards signals to it, and kills it if it does not react."""

    def __init__(self, child_pid: int, step_times: SharedStepTimes) -> None:
        self._child_pid = child_pid
        self._step_times = step_times
        self._signal_time_s: float | None = None
        self._handle = os.pidfd_open(child_pid)
        for number in list_stop_signals():
            signal.signal(number, self._forward_signal)

    def wait_for_exit(self) -> int:
        """Wait until the child has ended, and return the exit code of the command."""
        kill_reason = ""
        while not self._has_ended():
            if kill_reason:
                continue
            kill_reason = self._find_kill_reason()
            if kill_reason:
                os.kill(self._child_pid, signal.SIGKILL)
        _, wait_status = os.waitpid(self._child_pid, 0)
        code = os.waitstatus_to_exitcode(wait_status)
        was_killed = code < 0  # minus the number of the signal that ended it
        if kill_reason:
            print_stderr(f"snakesim: {kill_reason}; its process was killed. {RECORD_HINT}")
        if not was_killed:
            return code
        if self._signal_time_s is not None:
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
        if self._signal_time_s is None:
            self._signal_time_s = time.monotonic()
            os.kill(self._child_pid, number)
        elif number != signal.SIGHUP:  # the kernel and the shell both send one
            os.kill(self._child_pid, signal.SIGKILL)

    def _find_kill_reason(self) -> str:
        """Return why the child has to be killed; empty while the child makes progress."""
        step_times = self._step_times.read_step_times()
        if step_times is None:
            return ""
        start_s, due_s = step_times
        now_s = time.monotonic()
        if now_s > due_s + OVERDUE_TIMEOUT_S:
            return f"one step of the run took longer than {due_s - start_s:g} s, in compiled code"
        signal_time_s = self._signal_time_s
        if signal_time_s is not None and start_s <= signal_time_s < now_s - INTERRUPT_TIMEOUT_S:
            return (
                f"one step of the run had not returned {INTERRUPT_TIMEOUT_S:g} s after it "
                "received the signal to stop"
            )
        return ""


def _describe_end(number: int) -> str:
    """Return how a signal ended the child, as a clause."""
    if number == signal.SIGKILL:
        return "the process of the run was killed, perhaps for lack of memory"
    return f"the process of the run was ended by {signal.Signals(number).name}"

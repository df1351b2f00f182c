"""A run in one process as a child of its command, which ends the child whatever its code does.

Python runs a signal's handler between two steps of Python code. A controller that computes in compiled code without
end, as a model with a loop may, would make the process deaf to Ctrl-C. So the command forks before anything large is
loaded: the child runs, and the command waits, passes signals on, and kills a child that does not answer.
"""

import os
import select
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from snakesim_hal.base.process import die_with_parent, limit_memory, stop_signals
from snakesim_hal.base.step_limit import Pulse
from snakesim_hal.base.terminal import print_stderr

LOOK_S = 0.25
INTERRUPT_LIMIT_S = 3.0  # after Ctrl-C, for the present step; Python code is interrupted long before
OVERDUE_S = 5.0  # after a step is due, the same
FAILED, INTERRUPTED = 1, 130
WHERE = "What was recorded until then is in the run's folder; `snakesim recording report FOLDER` shows it"


def run_guarded(act: Callable[[Pulse | None], int], *, owns_process: bool) -> int:
    """Call a function in a child process that can be ended whatever it does. Returns its exit code.

    Args:
        act: gets the pulse by which it shows whether it goes on.
        owns_process: whether this process does nothing else. If not, it must not be copied, and the function is
            called right here.
    """
    if not owns_process:
        return act(None)
    sys.stdout.flush()
    sys.stderr.flush()
    pulse = Pulse()
    command = os.getpid()
    child = os.fork()
    if child != 0:
        return _Guard(child, pulse).wait()
    os.setsid()  # so that Ctrl-C reaches the command alone, which passes it on
    die_with_parent(command)
    limit_memory()
    return act(pulse)


class _Guard:
    """The command, while its child runs."""

    def __init__(self, child: int, pulse: Pulse) -> None:
        self._child = child
        self._pulse = pulse
        self._signalled_s: float | None = None
        self._handle = os.pidfd_open(child)
        for number in stop_signals():
            signal.signal(number, self._pass_on)

    def wait(self) -> int:
        """Wait until the child has ended. Returns the exit code of the command."""
        killed_because = ""
        while not select.select([self._handle], [], [], LOOK_S)[0]:
            if not killed_because and (why := self._why_to_kill()):
                killed_because = why
                os.kill(self._child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(self._child, 0)[1])
        if killed_because:
            print_stderr(f"snakesim: {killed_because}; its process was killed. {WHERE}")
        if self._signalled_s is not None:
            return INTERRUPTED if code < 0 else code
        if code < 0:
            if not killed_because:
                print_stderr(f"snakesim: {_how_it_ended(-code)}. {WHERE}")
            return FAILED
        return code

    def _pass_on(self, number: int, _frame: FrameType | None) -> None:
        """Handle a signal: the first one goes to the child, and another one ends it at once."""
        if self._signalled_s is None:
            self._signalled_s = time.monotonic()
            os.kill(self._child, number)
        elif number != signal.SIGHUP:  # it comes twice of itself, from the kernel and from the shell
            os.kill(self._child, signal.SIGKILL)

    def _why_to_kill(self) -> str:
        """Return why the child is to be killed; empty while it goes on."""
        step_s = self._pulse.read_step_times()
        if step_s is None:
            return ""
        began_s, due_s = step_s
        now_s = time.monotonic()
        if now_s > due_s + OVERDUE_S:
            return f"one step of the run took longer than {due_s - began_s:g} s, in compiled code"
        signalled_s = self._signalled_s
        if signalled_s is not None and began_s <= signalled_s < now_s - INTERRUPT_LIMIT_S:
            return f"one step of the run had not returned {INTERRUPT_LIMIT_S:g} s after it was told to stop"
        return ""


def _how_it_ended(number: int) -> str:
    if number == signal.SIGKILL:
        return "the process of the run was killed, perhaps for lack of memory"
    return f"the process of the run was ended by {signal.Signals(number).name}"

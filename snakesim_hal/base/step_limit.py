"""A limit on how long one step may take, for code that could compute without end, such as a controller.

A thread watches the steps of another one, and raises StepTooLongError in it. That reaches Python code, also an endless
loop. It does not reach compiled code that does not return: only another process can end that. `SharedStepTimes` show
that process which step is too long.
"""

import ctypes
import mmap
import threading
import time
import traceback
from typing import Self

WATCH_PERIOD_S = 0.25  # between two checks of the current step
INTERRUPT_AGAIN_S = 2.0  # until a step that has caught the error is interrupted again
STEP_TIMES_BYTES = 16  # start and deadline of the current step, two floats


class StepTooLongError(BaseException):
    """Raised in a step that takes too long. No `Exception`: what a controller catches must not catch it."""


class SharedStepTimes:
    """Start time and deadline of the current step, in memory that a forked process shares.

    Times are on the monotonic clock. Between steps, the start time is zero. Each time is stored as a whole, but another
    process may read between the two stores. It then sees a deadline before the start, and must not judge the step.
    """

    def __init__(self) -> None:
        # Start and deadline. `struct.pack_into` would clear the memory first, so that a reader could see zeros.
        self._times_s = memoryview(mmap.mmap(-1, STEP_TIMES_BYTES)).cast("d")

    def record_step_start(self, now_s: float, deadline_s: float) -> None:
        """Store the start time and the deadline of a step that starts now."""
        self._times_s[1] = deadline_s
        self._times_s[0] = now_s

    def record_step_end(self) -> None:
        """Store that no step is running."""
        self._times_s[0] = 0.0

    def read_step_times(self) -> tuple[float, float] | None:
        """Return the start time and the deadline of the current step, or None between steps."""
        start_s = self._times_s[0]
        deadline_s = self._times_s[1]
        if start_s == 0.0 or deadline_s < start_s:
            return None
        return start_s, deadline_s


class StepWatchdog:
    """Watchdog that interrupts a step which takes too long. Each `with` block on this object is one step.

    watchdog = StepWatchdog(60.0)
    with watchdog:
        controller.update(observation)  # raises StepTooLongError after 60 s
    watchdog.close()
    """

    def __init__(
        self,
        step_timeout_s: float,
        step_times: SharedStepTimes | None = None,
        error_type: type[BaseException] = StepTooLongError,
    ) -> None:
        """Create a watchdog that interrupts a step which takes too long.

        While steps run, a watcher thread compares their duration with the limit. When a step exceeds it, the watcher
        raises an exception in the thread of the step.

        Args:
            step_timeout_s: Maximum wall time of a step.
            step_times: Shared memory that shows start and deadline of the current step to another process. None if no
                other process needs to know.
            error_type: Class of the exception that is raised in a step. Two watchdogs that are nested need different
                classes.
        """
        self.step_timeout_s = step_timeout_s
        self._step_times = step_times
        self._error_type = error_type
        # A signal handler may interrupt its own thread while that holds it.
        self._lock = threading.RLock()
        self._closed = threading.Event()
        self._watcher: threading.Thread | None = None
        # The current step.
        self._step_start_time_s: float | None = None  # None between steps
        self._step_thread_id = 0
        self._last_interrupt_time_s: float | None = None  # None if the step was not interrupted
        # Set by `request_shutdown`: when it was called, and how long steps may take from then on.
        self._shutdown_request_time_s = 0.0
        self._grace_period_s: float | None = None  # None before the call

    def __enter__(self) -> Self:
        """Start a step, and at the first one the watcher thread."""
        if self._watcher is None:
            self._watcher = threading.Thread(target=self._watch, name="step limit", daemon=True)
            self._watcher.start()
        now_s = time.monotonic()
        self._step_thread_id = threading.get_ident()
        self._last_interrupt_time_s = None
        self._step_start_time_s = now_s
        if self._step_times is not None:
            self._step_times.record_step_start(now_s, now_s + self.step_timeout_s)
        return self

    def __exit__(self, *_error: object) -> None:
        """End the step; after this nothing is raised for it any more."""
        try:
            self._end_step()
        except self._error_type:  # raised at the very end
            self._end_step()
            raise

    def _end_step(self) -> None:
        """End the step, and withdraw an exception that was not raised yet."""
        with self._lock:
            self._step_start_time_s = None
            if self._last_interrupt_time_s is not None:
                _raise_in_thread(self._step_thread_id, None)
        if self._step_times is not None:
            self._step_times.record_step_end()

    def request_shutdown(self, grace_period_s: float) -> None:
        """Limit the current step and each later one to a grace period from now on. A signal handler may call this."""
        self._shutdown_request_time_s = time.monotonic()
        self._grace_period_s = grace_period_s

    @property
    def is_shutting_down(self) -> bool:
        """Return whether steps are limited to the grace period."""
        return self._grace_period_s is not None

    def close(self) -> None:
        """End the thread that watches the steps."""
        self._closed.set()
        if self._watcher is not None:
            self._watcher.join()

    def _watch(self) -> None:
        """Interrupt steps that take too long, until `close`."""
        while not self._closed.wait(WATCH_PERIOD_S):
            with self._lock:
                if self._step_start_time_s is not None and self._should_interrupt(
                    self._step_start_time_s, time.monotonic()
                ):
                    self._last_interrupt_time_s = time.monotonic()
                    _raise_in_thread(self._step_thread_id, self._error_type)

    def _should_interrupt(self, start_time_s: float, now_s: float) -> bool:
        """Return whether to interrupt the step that started at this time, for the first time or again."""
        if self._last_interrupt_time_s is not None:
            return now_s >= self._last_interrupt_time_s + INTERRUPT_AGAIN_S
        if now_s >= start_time_s + self.step_timeout_s:
            return True
        return (
            self._grace_period_s is not None
            and now_s >= max(start_time_s, self._shutdown_request_time_s) + self._grace_period_s
        )


def describe_interrupted_line(error: StepTooLongError) -> str:
    """Return where a step was when it was interrupted: `update() (wave.py line 12)`."""
    innermost = traceback.extract_tb(error.__traceback__)[-1]
    return f"{innermost.name}() ({innermost.filename.rpartition('/')[2]} line {innermost.lineno})"


def _raise_in_thread(thread_id: int, error_type: type[BaseException] | None) -> None:
    """Raise an exception in another thread as soon as that thread runs Python code.

    Args:
        thread_id: Identifier of the thread, as `threading.get_ident` returns it.
        error_type: Class of the exception. None withdraws an exception that was not raised yet.
    """
    exception = None if error_type is None else ctypes.py_object(error_type)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread_id), exception)

"""A limit on how long one step may take, for code that could compute without end, such as a controller.

A thread watches the steps of another one, and raises StepTooLongError in it. That reaches Python code, also an endless
loop. It does not reach compiled code that does not return: only another process can end that. `SharedStepTimes` show
that process which step is too long.
"""

import ctypes
import mmap
import struct
import threading
import time
import traceback
from typing import Self

WATCH_PERIOD_S = 0.25  # between two checks of the present step
INTERRUPT_AGAIN_S = 2.0  # until a step that has caught the error is interrupted again
TWO_TIMES = struct.Struct("dd")


class StepTooLongError(BaseException):
    """Raised in a step that takes too long. No `Exception`: what a controller catches must not catch it."""


class SharedStepTimes:
    """When the present step began, and by when it should have ended, in memory that a forked process shares.

    Times are on the monotonic clock.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, TWO_TIMES.size)

    def begin(self, now_s: float, due_s: float) -> None:
        """Note that a step begins."""
        TWO_TIMES.pack_into(self._memory, 0, now_s, due_s)

    def end(self) -> None:
        """Note that no step is going on."""
        TWO_TIMES.pack_into(self._memory, 0, 0.0, 0.0)

    def read_step_times(self) -> tuple[float, float] | None:
        """Return when the present step began and when it is due; None between steps."""
        began_s, due_s = TWO_TIMES.unpack_from(self._memory, 0)
        if not began_s:
            return None
        return began_s, due_s


class StepLimit:
    """Limits the steps of a thread: each `with` on this object is one.

    limit = StepLimit(60.0)
    with limit:
        controller.update(view)  # raises StepTooLongError after 60 s
    limit.close()
    """

    def __init__(
        self, limit_s: float, step_times: SharedStepTimes | None = None, error: type[BaseException] = StepTooLongError
    ) -> None:
        """Limit steps to `limit_s` each.

        Args:
            limit_s: maximum wall time of a step.
            step_times: shows another process when the present step began.
            error: the class of what is raised. Two limits that are nested need different classes.
        """
        self.limit_s = limit_s
        self._step_times = step_times
        self._error = error
        self._lock = threading.RLock()  # a signal handler may interrupt its own thread while that holds it
        self._closed = threading.Event()
        self._watcher: threading.Thread | None = None
        # The present step.
        self._began_s: float | None = None
        self._thread = 0
        self._interrupted_s: float | None = None
        # After `hurry`: when it was called, and how long steps may take from then on.
        self._hurried_s = 0.0
        self._grace_s: float | None = None

    def __enter__(self) -> Self:
        """Begin a step."""
        if self._watcher is None:
            self._watcher = threading.Thread(target=self._watch, name="step limit", daemon=True)
            self._watcher.start()
        now_s = time.monotonic()
        self._thread = threading.get_ident()
        self._interrupted_s = None
        self._began_s = now_s
        if self._step_times is not None:
            self._step_times.begin(now_s, now_s + self.limit_s)
        return self

    def __exit__(self, *_error: object) -> None:
        """End the step; after this nothing is raised for it any more."""
        try:
            self._end()
        except self._error:  # raised at the very end
            self._end()
            raise

    def _end(self) -> None:
        with self._lock:
            self._began_s = None
            if self._interrupted_s is not None:
                _raise_in(self._thread, None)
        if self._step_times is not None:
            self._step_times.end()

    def hurry(self, grace_s: float) -> None:
        """Give the present step and each later one only `grace_s` from now on. A signal handler may call this."""
        self._hurried_s = time.monotonic()
        self._grace_s = grace_s

    @property
    def is_hurried(self) -> bool:
        """Return whether steps get no more than a grace period."""
        return self._grace_s is not None

    def close(self) -> None:
        """End the thread that watches the steps."""
        self._closed.set()
        if self._watcher is not None:
            self._watcher.join()

    def _watch(self) -> None:
        """Interrupt steps that take too long, until `close`."""
        while not self._closed.wait(WATCH_PERIOD_S):
            with self._lock:
                if self._began_s is not None and self._is_due(self._began_s, time.monotonic()):
                    self._interrupted_s = time.monotonic()
                    _raise_in(self._thread, self._error)

    def _is_due(self, began_s: float, now_s: float) -> bool:
        """Return whether the present step is to be interrupted now."""
        if self._interrupted_s is not None:
            return now_s >= self._interrupted_s + INTERRUPT_AGAIN_S
        if now_s >= began_s + self.limit_s:
            return True
        return self._grace_s is not None and now_s >= max(began_s, self._hurried_s) + self._grace_s


def describe_interrupted_line(error: StepTooLongError) -> str:
    """Return where a step was when it was interrupted: `update() (wave.py line 12)`."""
    innermost = traceback.extract_tb(error.__traceback__)[-1]
    return f"{innermost.name}() ({innermost.filename.rpartition('/')[2]} line {innermost.lineno})"


def _raise_in(thread: int, error: type[BaseException] | None) -> None:
    """Raise an error in a thread as soon as it runs Python code; None withdraws one that was not raised yet."""
    pending = None if error is None else ctypes.py_object(error)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), pending)

"""Worker threads that do not die unnoticed: an unexpected error is reported, and the work continues.

A thread that ends by an exception ends nothing else, so its failure is easily missed, and other threads wait for its
work for ever: an emergency stop is not served, or a log is not read. So every thread that serves others begins again
after an error of any kind, and prints the error to stderr.
"""

import contextlib
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar

from snakesim_hal.base.terminal import print_stderr

# The pause between an error and the next attempt. It doubles with each error in a row.
FIRST_PAUSE_S = 0.05
MAX_PAUSE_S = 2.0
# After a run of this length without an error, the next pause is the first one again.
PAUSE_RESET_S = 10.0
REPORT_INTERVAL_S = 60.0  # the same error of one worker is printed at most once in this time
REPORTED_LINE_COUNT = 6  # of a traceback: the last ones name the error and where it was raised
MAX_ERROR_KEY_LENGTH = 200  # characters of an error, by which repetitions are recognized
MAX_ERROR_KEYS = 100  # remembered; more means that all errors differ
ResultT = TypeVar("ResultT")


def start_restarting_thread(
    name: str,
    target: Callable[[], None],
    *,
    should_stop: Callable[[], bool] = lambda: False,
    on_error: Callable[[Exception], None] | None = None,
) -> threading.Thread:
    """Start a daemon thread that calls a function, and calls it again after each unexpected error.

    The thread ends when the function returns, or when it has raised an error and `should_stop` returns True. Errors are
    printed to stderr, and followed by a pause.

    Args:
        name: Thread name. Log messages about its errors are prefixed with it.
        target: Function that the thread runs, as a rule a loop. It must not keep state in local variables, because it
            is called again after an error.
        should_stop: Returns whether the thread should end instead of calling the function again. Called after an error.
        on_error: Called with each error, to discard the input that caused the error. Errors that it raises itself are
            printed as well.

    Returns:
        The started thread.
    """
    arguments = (name, target, should_stop, on_error)
    thread = threading.Thread(target=_run_with_restart, args=arguments, name=name, daemon=True)
    thread.start()
    return thread


def _run_with_restart(
    name: str,
    target: Callable[[], None],
    should_stop: Callable[[], bool],
    on_error: Callable[[Exception], None] | None,
) -> None:
    """Call a function until it returns or should stop. After each unexpected error, report it, pause, and call again.

    The pause doubles with each error, up to MAX_PAUSE_S, until a call has lasted PAUSE_RESET_S.

    Args:
        name: Prefix of the error reports.
        target: The function.
        should_stop: Returns whether to end instead of calling the function again. Called after an error.
        on_error: Called with each error; None if nothing needs to be cleaned up.
    """
    reporter = ErrorReporter(name)
    pause_s = FIRST_PAUSE_S
    while True:
        start_s = time.monotonic()
        try:
            target()
            return
        except Exception as error:  # noqa: BLE001 - this thread's outermost loop: it reports, and continues
            reporter.print_error(error)
            if on_error is not None:
                _call_error_handler(error, on_error, reporter)
        if should_stop():
            return
        if time.monotonic() - start_s > PAUSE_RESET_S:
            pause_s = FIRST_PAUSE_S
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, MAX_PAUSE_S)


def _call_error_handler(
    error: Exception, on_error: Callable[[Exception], None], reporter: "ErrorReporter"
) -> None:
    """Call an error handler, and report an error that it raises itself."""
    try:
        on_error(error)
    except Exception as handler_error:  # noqa: BLE001 - part of this thread's outermost loop
        reporter.print_error(handler_error)


class ErrorReporter:
    """Prints the unexpected errors of one thread to stderr, but equal errors at most once a minute."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._last_printed_s: dict[str, float] = {}  # by the text of the error

    def print_error(self, error: BaseException) -> None:
        """Print an error with the end of its traceback, unless an equal one was printed in the last minute."""
        now_s = time.monotonic()
        error_key = f"{type(error).__name__}: {error}"[:MAX_ERROR_KEY_LENGTH]
        if now_s - self._last_printed_s.get(error_key, -REPORT_INTERVAL_S) < REPORT_INTERVAL_S:
            return
        if len(self._last_printed_s) > MAX_ERROR_KEYS:
            self._last_printed_s.clear()
        self._last_printed_s[error_key] = now_s
        lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
        with contextlib.suppress(OSError, ValueError):  # stderr is closed, or its disk is full
            print_stderr(f"{self._name}: unexpected error, but it continues: {error_key}")
            for line in lines[-REPORTED_LINE_COUNT:-1]:
                print_stderr(f"{self._name}:   {line.strip()}")


class BackgroundThread:
    """A thread that is started before it is needed, and runs queued jobs one after another."""

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = SimpleQueue()
        self._thread = start_restarting_thread(name, self._run_jobs)

    @property
    def name(self) -> str:
        """The name of its thread."""
        return self._thread.name

    def submit(self, job: Callable[[], ResultT]) -> "Future[ResultT]":
        """Queue a job, and return the future of its result. The future also carries an error that the job raises."""
        future: Future[ResultT] = Future()
        self._jobs.put((job, future))
        return future

    def close(self) -> None:
        """Tell the thread to end after the queued jobs. This does not wait for its end."""
        self._jobs.put(None)

    def _run_jobs(self) -> None:
        """Run queued jobs until `close` queues None."""
        while (queued := self._jobs.get()) is not None:
            job, future = queued
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = job()
            except Exception as error:  # noqa: BLE001 - this thread's outermost loop: the future has the error
                future.set_exception(error)
            else:
                future.set_result(result)

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
CALM_S = 10.0  # a worker that ran this long without an error begins again with the first pause
REPORT_EVERY_S = 60.0  # the same error of one worker is printed once in this time
LINES_REPORTED = 6  # of a traceback: the last ones name the error and where it was raised
MAX_KIND_LENGTH = 200  # characters of an error, by which it is recognized
MAX_KINDS = 100  # remembered; more means that all errors differ
ResultT = TypeVar("ResultT")


def start_worker(
    name: str,
    work: Callable[[], None],
    *,
    is_over: Callable[[], bool] = lambda: False,
    on_error: Callable[[Exception], None] | None = None,
) -> threading.Thread:
    """Start a daemon thread that calls `work` until it returns, and again after each unexpected error.

    Args:
        name: Name of the thread, which its reports begin with.
        work: The loop of the thread. It keeps its state outside, because it may be called again.
        is_over: Returns whether the work is to end. It is called after an error.
        on_error: Called after an error, to drop what caused it. What it raises is reported, too.
    """
    worker = threading.Thread(target=_work_on, args=(name, work, is_over, on_error), name=name, daemon=True)
    worker.start()
    return worker


def _work_on(
    name: str, work: Callable[[], None], is_over: Callable[[], bool], on_error: Callable[[Exception], None] | None
) -> None:
    """Call `work` until it returns, with a pause after each unexpected error."""
    report = ErrorReport(name)
    pause_s = FIRST_PAUSE_S
    while True:
        began_s = time.monotonic()
        try:
            work()
            return
        except Exception as error:  # noqa: BLE001 - this thread's outermost loop: it reports, and continues
            report.write(error)
            if on_error is not None:
                _clean_up(error, on_error, report)
        if is_over():
            return
        if time.monotonic() - began_s > CALM_S:
            pause_s = FIRST_PAUSE_S
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, MAX_PAUSE_S)


def _clean_up(error: Exception, on_error: Callable[[Exception], None], report: "ErrorReport") -> None:
    try:
        on_error(error)
    except Exception as another:  # noqa: BLE001 - part of this thread's outermost loop
        report.write(another)


class ErrorReport:
    """Prints the unexpected errors of one worker to stderr: each kind at once, and then once a minute."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._printed_s: dict[str, float] = {}

    def write(self, error: BaseException) -> None:
        """Print an error, and where it was raised."""
        now_s = time.monotonic()
        kind = f"{type(error).__name__}: {error}"[:MAX_KIND_LENGTH]
        if now_s - self._printed_s.get(kind, -REPORT_EVERY_S) < REPORT_EVERY_S:
            return
        if len(self._printed_s) > MAX_KINDS:
            self._printed_s.clear()
        self._printed_s[kind] = now_s
        lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
        with contextlib.suppress(OSError, ValueError):  # stderr is closed, or its disk is full
            print_stderr(f"{self._name}: unexpected error, going on: {kind}")
            for line in lines[-LINES_REPORTED:-1]:
                print_stderr(f"{self._name}:   {line.strip()}")


class Worker:
    """A thread that exists before it is needed, and carries out one job after another."""

    def __init__(self, name: str) -> None:
        self._jobs: SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = SimpleQueue()
        self._thread = start_worker(name, self._carry_out)

    @property
    def name(self) -> str:
        """The name of its thread."""
        return self._thread.name

    def submit(self, job: Callable[[], ResultT]) -> "Future[ResultT]":
        """Queue a job. The future has its result, or whatever the job raised."""
        future: Future[ResultT] = Future()
        self._jobs.put((job, future))
        return future

    def close(self) -> None:
        """End the thread after the jobs that are queued; does not wait for it."""
        self._jobs.put(None)

    def _carry_out(self) -> None:
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

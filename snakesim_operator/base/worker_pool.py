"""Worker processes on this computer, which call functions for evaluations, searches and training.

    with WorkerPool(4) as pool:
        for number, outcome in pool.run(function, calls):
            ...  # as soon as each call is done

No port is opened: each worker has one end of a socket pair, which no other process can open. A worker that dies is
replaced, and its call is tried again. At the end of the `with`, also after an exception, all workers are killed and
their temporary files are removed.
"""

import contextlib
import fcntl
import os
import pickle
import shutil
import signal
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import gettempdir, mkdtemp
from typing import Any, Self

from snakesim_hal.base import arithmetic
from snakesim_hal.base.process import (
    make_child_environment,
    make_python_command,
    set_parent_death_signal,
)

MAX_WORKER_DEATHS = 5  # workers that may die while they run a call, before the call fails
# Attempts of a call that raises an exception: the cause may have been the worker.
MAX_FAILED_ATTEMPTS = 3
NICENESS = 10  # robots and consoles on the same computer have priority
TEMPORARY_FOLDER_VARIABLE = "TMPDIR"  # of the environment
# With `-m`, the classes of this module would be those of `__main__`, and would not be equal to the command's.
WORKER_PROGRAM = f"import sys; from {__name__} import main; sys.exit(main(sys.argv[1:]))"
MAX_UNLOCKED_S = 60.0  # a folder of a running pool is locked long before
FOLDER_PREFIX = "snakesim-workers-"


class WorkerDiedError(Exception):
    """The workers that ran a call died, MAX_WORKER_DEATHS times."""


class CallTookTooLongError(Exception):
    """A call took longer than it may; its worker was killed."""


@dataclass(frozen=True)
class CallResult:
    """The outcome of a call that returned."""

    value: Any


@dataclass(frozen=True)
class CallFailure:
    """The outcome of a call that raised, that took too long, or that killed its workers."""

    error: Exception


Outcome = CallResult | CallFailure


@dataclass
class _PendingCall:
    """A call that is waiting or running."""

    number: int
    arguments: Sequence[Any]
    worker_death_count: int = 0  # of workers that died while they ran this call
    exception_count: int = 0  # of exceptions that the function raised
    deadline_s: float = float("inf")  # on the monotonic clock, after the call has begun


class WorkerPool:
    """Calls functions in worker processes, one call at a time in each."""

    def __init__(self, count: int | None = None) -> None:
        """Prepare a pool. Workers are started when they are needed.

        Args:
            count: Maximum number of processes; None for one per core that this process may use.
        """
        self.size = count or len(os.sched_getaffinity(0))
        self._workers: list[_WorkerProcess] = []
        self._folder: Path | None = None
        self._started_worker_count = 0

    def __enter__(self) -> Self:
        _remove_abandoned_folders()
        self._folder = Path(mkdtemp(prefix=FOLDER_PREFIX))
        self._lock = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(self._lock, fcntl.LOCK_EX)  # shows that the folder is in use
        return self

    def __exit__(self, *_error: object) -> None:
        for worker in self._workers:
            worker.kill()
        self._workers.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            os.close(self._lock)

    def run_calls(
        self,
        function: Callable[..., Any],
        calls: Sequence[Sequence[Any]],
        timeout_s: float | None = None,
    ) -> Iterator[tuple[int, Outcome]]:
        """Call a function once for each tuple of arguments.

        Args:
            function: Function at the top level of a module, which the worker imports.
            calls: Arguments of each call. Calls start in this order.
            timeout_s: Maximum wall time of a call in s, after which its worker is killed; None for no timeout.

        Yields:
            The index of a call in `calls` and its outcome, as soon as the call is done.
        """
        waiting = deque(_PendingCall(number, arguments) for number, arguments in enumerate(calls))
        running: dict[_WorkerProcess, _PendingCall] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.size:
                    call = waiting.popleft()
                    worker = self._find_idle_worker(running)
                    if timeout_s is not None:
                        call.deadline_s = time.monotonic() + timeout_s
                    worker.send((function, call.arguments))
                    running[worker] = call
                for worker in self._wait_for_workers(running):
                    call = running.pop(worker)
                    outcome = self._finish_attempt(worker, call)
                    if outcome is None:  # it is tried again, before the calls that have not started
                        waiting.appendleft(call)
                    else:
                        yield call.number, outcome
        finally:
            # If the caller stops early, later calls must not receive the outcomes of these.
            for worker in running:
                self._kill_and_remove(worker)

    def run_and_collect(
        self, function: Callable[..., Any], calls: Sequence[Sequence[Any]]
    ) -> list[Any]:
        """Run calls and return their values in the order of the calls. Raises the exception of a call that fails."""
        values: dict[int, Any] = {}
        for number, outcome in self.run_calls(function, calls):
            if isinstance(outcome, CallFailure):
                raise outcome.error
            values[number] = outcome.value
        return [values[number] for number in range(len(calls))]

    def _find_idle_worker(self, running: "dict[_WorkerProcess, _PendingCall]") -> "_WorkerProcess":
        """Return a worker without a call; a new one is started if there is none."""
        for worker in self._workers:
            if worker not in running:
                return worker
        assert self._folder is not None, "the pool is used outside its `with`"
        folder = self._folder / str(self._started_worker_count)
        folder.mkdir()
        self._started_worker_count += 1
        worker = _WorkerProcess(folder)
        self._workers.append(worker)
        return worker

    def _wait_for_workers(
        self, running: "dict[_WorkerProcess, _PendingCall]"
    ) -> "list[_WorkerProcess]":
        """Wait until calls are done, have failed, or take too long, and return their workers."""
        remaining_s = min(call.deadline_s for call in running.values()) - time.monotonic()
        timeout_s = None if remaining_s == float("inf") else max(remaining_s, 0.0)
        readable = wait([worker.connection for worker in running], timeout_s)
        now_s = time.monotonic()
        return [
            worker
            for worker, call in running.items()
            if worker.connection in readable or now_s >= call.deadline_s
        ]

    def _finish_attempt(self, worker: "_WorkerProcess", call: _PendingCall) -> Outcome | None:
        """Receive the outcome of a call from its worker, and remove a worker that is dead or takes too long.

        A call that takes too long fails at once. It is tried again if its worker died, in all up to MAX_WORKER_DEATHS
        times, or if the function raised, in all up to MAX_FAILED_ATTEMPTS times.

        Args:
            worker: Worker of the call, from `_wait_for_workers`: it has sent something, has died, or takes too long.
            call: The call, whose failed attempts are counted here.

        Returns:
            The outcome, or None if the call has to be tried again.
        """
        # The connection of a worker that has died is readable, too.
        is_readable = worker.connection.poll()
        if not is_readable:
            self._kill_and_remove(worker)
            return CallFailure(CallTookTooLongError())
        try:
            outcome = worker.connection.recv()
        except (EOFError, OSError):
            self._kill_and_remove(worker)
            call.worker_death_count += 1
            if call.worker_death_count < MAX_WORKER_DEATHS:
                return None
            return CallFailure(WorkerDiedError())
        if isinstance(outcome, CallFailure):
            call.exception_count += 1
            if call.exception_count < MAX_FAILED_ATTEMPTS:
                return None
        return outcome

    def _kill_and_remove(self, worker: "_WorkerProcess") -> None:
        """Kill a worker and remove its temporary files."""
        worker.kill()
        self._workers.remove(worker)
        shutil.rmtree(worker.folder, ignore_errors=True)


def _remove_abandoned_folders() -> None:
    """Remove the folders that killed pools of this user have left."""
    for folder in Path(gettempdir()).glob(f"{FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):
            state = folder.lstat()
            if state.st_uid != os.geteuid() or time.time() - state.st_ctime < MAX_UNLOCKED_S:
                continue
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                # Raises for a folder that is in use.
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(handle)


@dataclass(eq=False)
class _WorkerProcess:
    """A worker process, as the process that started it controls it."""

    folder: Path  # for the worker's temporary files
    connection: Connection = field(init=False)

    def __post_init__(self) -> None:
        command_end, worker_end = socket.socketpair()
        with worker_end:
            self._process = subprocess.Popen(
                make_python_command(
                    "-c", WORKER_PROGRAM, str(worker_end.fileno()), str(os.getpid())
                ),
                env=make_child_environment(
                    arithmetic.make_common_arithmetic_env(),
                    arithmetic.SINGLE_THREAD_ENV,
                    {TEMPORARY_FOLDER_VARIABLE: str(self.folder)},
                ),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C then reaches the command alone, also while the worker starts
                pass_fds=[worker_end.fileno()],
            )
        self.connection = Connection(command_end.detach())

    def send(self, job: tuple[Callable[..., Any], Sequence[Any]]) -> None:
        """Send a call to the worker. If the worker has died, this is noticed when its outcome is read."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(job)

    def kill(self) -> None:
        """Kill the worker, and wait until it has ended."""
        self._process.kill()
        self._process.wait()
        self.connection.close()


def main(argv: Sequence[str]) -> int:
    """Run the worker: receive calls and send their outcomes, until the command closes the connection.

    Args:
        argv: File descriptor of the worker's end of the socket pair, and process id of the command.

    Returns:
        The exit code.
    """
    connection_fd, parent_pid = map(int, argv)
    set_parent_death_signal(parent_pid)
    # A command that was started with `nice` keeps its priority.
    os.nice(max(NICENESS - os.nice(0), 0))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(connection_fd) as connection:
        while True:
            try:
                function, arguments = connection.recv()
            except (EOFError, ConnectionResetError):
                return 0
            try:
                outcome: Outcome = CallResult(function(*arguments))
            except Exception as error:  # noqa: BLE001 - the caller gets every exception
                outcome = CallFailure(_make_picklable(error))
            connection.send(outcome)


def _make_picklable(error: Exception) -> Exception:
    """Return the exception, or a RuntimeError with its text if the exception cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - pickling runs code of the exception's class
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error

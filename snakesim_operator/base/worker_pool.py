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
from snakesim_hal.base.process import child_environment, die_with_parent, python_command

MAX_DEATHS = 5  # workers that may die while they run a call, before the call fails
MAX_RAISES = 3  # attempts of a call that raises an exception: the cause may have been the worker
NICENESS = 10  # robots and consoles on the same computer have priority
TEMPORARY_FOLDER_VARIABLE = "TMPDIR"  # of the environment
# With `-m`, the classes of this module would be those of `__main__`, and would not be equal to the command's.
WORKER_PROGRAM = f"import sys; from {__name__} import main; sys.exit(main(sys.argv[1:]))"
MAX_UNLOCKED_S = 60.0  # a folder of a running pool is locked long before
FOLDER_PREFIX = "snakesim-workers-"


class WorkerDiedError(Exception):
    """The workers that ran a call died, `MAX_DEATHS` times."""


class CallTookTooLongError(Exception):
    """A call took longer than it may; its worker was killed."""


@dataclass(frozen=True)
class Returned:
    """The outcome of a call that returned."""

    value: Any


@dataclass(frozen=True)
class Raised:
    """The outcome of a call that raised, that took too long, or that killed its workers."""

    error: Exception


Outcome = Returned | Raised


@dataclass
class _Call:
    """A call that is not done yet."""

    number: int
    arguments: Sequence[Any]
    deaths: int = 0
    raises: int = 0
    deadline_s: float = float("inf")  # on the monotonic clock, after the call has begun


class WorkerPool:
    """Calls functions in processes, one call at a time in each."""

    def __init__(self, count: int | None = None) -> None:
        """Make a pool without workers; they are started when they are needed.

        Args:
            count: maximum number of processes; None: one for each core that this process may use.
        """
        self.size = count or len(os.sched_getaffinity(0))
        self._workers: list[_Worker] = []
        self._folder: Path | None = None
        self._started = 0

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

    def run(
        self, function: Callable[..., Any], calls: Sequence[Sequence[Any]], limit_s: float | None = None
    ) -> Iterator[tuple[int, Outcome]]:
        """Call a function once for each tuple of arguments.

        Args:
            function: on the top level of a module, which the worker imports.
            calls: the arguments of each call. Calls begin in this order.
            limit_s: maximum wall time of a call, after which its worker is killed; None: no limit.

        Yields:
            The index of a call in `calls` and its outcome, as soon as the call is done.
        """
        waiting = deque(_Call(number, arguments) for number, arguments in enumerate(calls))
        running: dict[_Worker, _Call] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.size:
                    call = waiting.popleft()
                    worker = self._find_idle_worker(running)
                    if limit_s is not None:
                        call.deadline_s = time.monotonic() + limit_s
                    worker.send((function, call.arguments))
                    running[worker] = call
                for worker in self._wait_for_workers(running):
                    call = running.pop(worker)
                    outcome = self._receive(worker, call)
                    if outcome is None:
                        waiting.appendleft(call)
                    else:
                        yield call.number, outcome
        finally:
            # If the caller stops early, later calls must not receive the outcomes of these.
            for worker in running:
                self._discard(worker)

    def map(self, function: Callable[..., Any], calls: Sequence[Sequence[Any]]) -> list[Any]:
        """Return the values of the calls, in their order. Raises the exception of the first call that fails."""
        values: dict[int, Any] = {}
        for number, outcome in self.run(function, calls):
            if isinstance(outcome, Raised):
                raise outcome.error
            values[number] = outcome.value
        return [values[number] for number in range(len(calls))]

    def _find_idle_worker(self, running: "dict[_Worker, _Call]") -> "_Worker":
        """Return a worker without a call; a new one is started if there is none."""
        for worker in self._workers:
            if worker not in running:
                return worker
        assert self._folder is not None, "the pool is used outside its `with`"
        folder = self._folder / str(self._started)
        folder.mkdir()
        self._started += 1
        worker = _Worker(folder)
        self._workers.append(worker)
        return worker

    def _wait_for_workers(self, running: "dict[_Worker, _Call]") -> "list[_Worker]":
        """Wait until calls are done, have failed, or take too long, and return their workers."""
        left_s = min(call.deadline_s for call in running.values()) - time.monotonic()
        timeout_s = None if left_s == float("inf") else max(left_s, 0.0)
        readable = wait([worker.connection for worker in running], timeout_s)
        now_s = time.monotonic()
        return [worker for worker, call in running.items() if worker.connection in readable or now_s >= call.deadline_s]

    def _receive(self, worker: "_Worker", call: _Call) -> Outcome | None:
        """Return the outcome of a call, or None if the call is tried again.

        A call is tried again if its worker died or the function raised, unless this has happened too often.

        Args:
            worker: The worker of the call. If it has sent nothing yet, the call has exceeded its time, and the worker
                is ended.
            call: The call, whose failures are counted.
        """
        is_done = worker.connection.poll()
        if not is_done:
            self._discard(worker)
            return Raised(CallTookTooLongError())
        try:
            outcome = worker.connection.recv()
        except (EOFError, OSError):
            self._discard(worker)
            call.deaths += 1
            if call.deaths < MAX_DEATHS:
                return None
            return Raised(WorkerDiedError())
        if isinstance(outcome, Raised):
            call.raises += 1
            if call.raises < MAX_RAISES:
                return None
        return outcome

    def _discard(self, worker: "_Worker") -> None:
        """Kill a worker and remove its temporary files."""
        worker.kill()
        self._workers.remove(worker)
        shutil.rmtree(worker.folder, ignore_errors=True)


def _remove_abandoned_folders() -> None:
    """Remove the folders of this user's pools that were killed, and could not remove them."""
    for folder in Path(gettempdir()).glob(f"{FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):
            state = folder.lstat()
            if state.st_uid != os.geteuid() or time.time() - state.st_ctime < MAX_UNLOCKED_S:
                continue
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises for a folder that is in use
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(handle)


@dataclass(eq=False)
class _Worker:
    """A worker process, as the process that started it controls it."""

    folder: Path  # for the worker's temporary files
    connection: Connection = field(init=False)

    def __post_init__(self) -> None:
        command_end, worker_end = socket.socketpair()
        with worker_end:
            self._process = subprocess.Popen(
                python_command("-c", WORKER_PROGRAM, str(worker_end.fileno()), str(os.getpid())),
                env=child_environment(
                    arithmetic.common_environment(),
                    arithmetic.ONE_THREAD,
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
        argv: the handle of the worker's end of the socket pair, and the process id of the command.
    """
    handle, parent = map(int, argv)
    die_with_parent(parent)
    os.nice(max(NICENESS - os.nice(0), 0))  # a command that was started with `nice` keeps its priority
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(handle) as connection:
        while True:
            try:
                function, arguments = connection.recv()
            except (EOFError, ConnectionResetError):
                return 0
            try:
                outcome: Outcome = Returned(function(*arguments))
            except Exception as error:  # noqa: BLE001 - the caller gets every exception
                outcome = Raised(_portable(error))
            connection.send(outcome)


def _portable(error: Exception) -> Exception:
    """Return the exception, or a RuntimeError with its text if the exception cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - pickling runs code of the exception's class
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error

"""Worker processes on this computer, which call functions for evaluations, searches and training.

    with WorkerPool(4) as pool:
        for number, outcome in pool.run(function, calls):
            ...  # as each call is done

Nothing listens anywhere: each worker has one end of a socket pair, which no other process can open. A worker that dies
is replaced and its call is tried again. At the end of the `with`, however it ends, all workers are killed and their
temporary files are removed.
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

MAX_DEATHS = 5  # of the workers that run a call, until the call is given up
MAX_RAISES = 3  # of a call, until its exception is its outcome: the fault may have been the worker's
NICENESS = 10  # robots and consoles that run meanwhile come first
TEMPORARY_FILES = "TMPDIR"  # the variable that names the folder for them
BEGIN = f"import sys; from {__name__} import main; sys.exit(main(sys.argv[1:]))"  # not -m: classes are of this module
UNLOCKED_S = 60.0  # a new folder is locked long before
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
    deadline_s: float = float("inf")  # on the monotonic clock, once it has begun


class WorkerPool:
    """Calls functions in processes, one call at a time in each."""

    def __init__(self, count: int | None = None) -> None:
        """count: how many processes; None: one for each core that this process may use."""
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
        """Call the function of a module once for each tuple of arguments.

        Args:
            function: found by its name in the worker, which imports its module.
            calls: the arguments of each call. They begin in this order.
            limit_s: wall time of a call, after which its worker is killed.

        Yields:
            The place of a call in `calls`, and its outcome, as each is done.
        """
        waiting = deque(_Call(number, arguments) for number, arguments in enumerate(calls))
        running: dict[_Worker, _Call] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.size:
                    call = waiting.popleft()
                    worker = self._idle_worker(running)
                    call.deadline_s = float("inf") if limit_s is None else time.monotonic() + limit_s
                    worker.send((function, call.arguments))
                    running[worker] = call
                for worker in self._workers_with_news(running):
                    call = running.pop(worker)
                    outcome = self._receive(worker, call)
                    if outcome is None:
                        waiting.appendleft(call)
                    else:
                        yield call.number, outcome
        finally:
            for worker in running:  # the caller wants no more: their answers must not be taken for later ones
                self._discard(worker)

    def map(self, function: Callable[..., Any], calls: Sequence[Sequence[Any]]) -> list[Any]:
        """Return what each call returns, in the order of the calls. Raises what the first failed call raised."""
        values: dict[int, Any] = {}
        for number, outcome in self.run(function, calls):
            if isinstance(outcome, Raised):
                raise outcome.error
            values[number] = outcome.value
        return [values[number] for number in range(len(calls))]

    def _idle_worker(self, running: "dict[_Worker, _Call]") -> "_Worker":
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

    def _workers_with_news(self, running: "dict[_Worker, _Call]") -> "list[_Worker]":
        """Wait until calls are done, have failed, or take too long; return their workers."""
        until_s = min(call.deadline_s for call in running.values()) - time.monotonic()
        timeout_s = None if until_s == float("inf") else max(until_s, 0.0)
        readable = wait([worker.connection for worker in running], timeout_s)
        now = time.monotonic()
        return [worker for worker, call in running.items() if worker.connection in readable or now >= call.deadline_s]

    def _receive(self, worker: "_Worker", call: _Call) -> Outcome | None:
        """Return the outcome of a call; None when it is to be tried again."""
        if not worker.connection.poll():
            self._discard(worker)
            return Raised(CallTookTooLongError())
        try:
            outcome = worker.connection.recv()
        except (EOFError, OSError):
            self._discard(worker)
            call.deaths += 1
            return Raised(WorkerDiedError()) if call.deaths >= MAX_DEATHS else None
        if isinstance(outcome, Raised):
            call.raises += 1
            return outcome if call.raises >= MAX_RAISES else None
        return outcome

    def _discard(self, worker: "_Worker") -> None:
        worker.kill()
        self._workers.remove(worker)
        shutil.rmtree(worker.folder, ignore_errors=True)


def _remove_abandoned_folders() -> None:
    """Remove the folders of commands of this user that were killed."""
    for folder in Path(gettempdir()).glob(f"{FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError):
            state = folder.lstat()
            if state.st_uid != os.geteuid() or time.time() - state.st_ctime < UNLOCKED_S:
                continue
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails for one that is in use
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(handle)


@dataclass(eq=False)
class _Worker:
    """One process, seen from the command that started it."""

    folder: Path  # for its temporary files
    connection: Connection = field(init=False)

    def __post_init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                python_command("-c", BEGIN, str(theirs.fileno()), str(os.getpid())),
                env=child_environment(
                    arithmetic.common_environment(), arithmetic.ONE_THREAD, {TEMPORARY_FILES: str(self.folder)}
                ),
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # so that Ctrl-C reaches the command alone, also while this one starts
                pass_fds=[theirs.fileno()],
            )
        self.connection = Connection(ours.detach())

    def send(self, job: tuple[Callable[..., Any], Sequence[Any]]) -> None:
        """Have it make a call. One that has died is noticed when its answer is read."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send(job)

    def kill(self) -> None:
        """End it, and wait until it has ended."""
        self._process.kill()
        self._process.wait()
        self.connection.close()


def main(argv: Sequence[str]) -> int:
    """The worker itself. The arguments are its end of the socket pair and its parent's process id."""
    handle, parent = map(int, argv)
    die_with_parent(parent)
    os.nice(max(NICENESS - os.nice(0), 0))  # a command under `nice` is not sent further back
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(handle) as connection:
        while True:
            try:
                function, arguments = connection.recv()
            except (EOFError, ConnectionResetError):
                return 0
            try:
                outcome: Outcome = Returned(function(*arguments))
            except Exception as error:  # noqa: BLE001 - whatever it is, the caller gets it
                outcome = Raised(_portable(error))
            connection.send(outcome)


def _portable(error: Exception) -> Exception:
    """The exception, or one with its text if another process could not read it."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - pickling runs code of the exception's class
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error

"""The child processes of a run: started together, monitored, ended by id, and never left behind."""

import contextlib
import fcntl
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from snakesim_hal.base import arithmetic
from snakesim_hal.base.process import child_environment, python_command
from snakesim_hal.base.workers import start_worker

STOP_LIMIT_S = 5.0
LINES_SHOWN, LAST_BYTES = 15, 16384
PIPE_BYTES = 2**20  # of output, while this process is frozen


class ProcessOutput:
    """The output of a process: read from a pipe at once, so that it never waits for a disk, and passed on."""

    def __init__(self, pipe: int, keep: Callable[[bytes], object]) -> None:
        self._pipe, self._keep = pipe, keep
        self._last = b""
        self._thread = start_worker("words", self._listen)

    def last(self) -> list[str]:
        """The last lines of its stdout and stderr, once it has ended."""
        self._thread.join(1.0)
        return self._last.decode(errors="replace").strip().splitlines()[-LINES_SHOWN:]

    def _listen(self) -> None:
        with contextlib.suppress(OSError):  # a larger pipe than the default
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        while words := os.read(self._pipe, 65536):
            self._last = (self._last + words)[-LAST_BYTES:]
            self._keep(words)
        os.close(self._pipe)


@dataclass(frozen=True)
class Child:
    """One process, and its output."""

    name: str
    process: subprocess.Popen[bytes]
    words: ProcessOutput

    def how_it_ended(self) -> str | None:
        """Its exit as text; None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        if code < 0:
            return f"{self.name} was ended by {signal.Signals(-code).name}"
        why = (self.words.last() or [""])[-1]
        said = f"snakesim {self.name}: "
        return f"{self.name} ended with exit code {code}" + (f": {why[len(said) :]}" if why.startswith(said) else "")


def start(
    name: str,
    arguments: Sequence[str],
    keep: Callable[[bytes], object],
    *,
    inherits: Sequence[int] = (),
    more: Mapping[str, str] = MappingProxyType({}),
) -> Child:
    """Start a Python module as a child that dies with this process.

    keep: gets its output, from another thread; inherits: file descriptors that stay open in it; more: environment
    variables.

    It gets a session of its own, so that Ctrl-C reaches only the supervisor, which then ends its children in order.
    A SIGINT that comes while its interpreter starts waits until it has a handler.
    """
    reproducible = {"PYTHONUNBUFFERED": "1", "PYTHONHASHSEED": "0"}
    environment = child_environment(arithmetic.environment(), arithmetic.ONE_THREAD, reproducible, more)
    ours, theirs = os.pipe()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited
    try:
        process = subprocess.Popen(
            python_command("-m", *arguments, "--parent", str(os.getpid())),
            stdin=subprocess.DEVNULL,
            stdout=theirs,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            pass_fds=inherits,
        )
    except OSError:
        os.close(ours)
        raise
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.close(theirs)
    return Child(name, process, ProcessOutput(ours, keep))


def ask_to_end(child: Child) -> None:
    """Terminate a child in order; a frozen one must be continued first."""
    if child.process.poll() is None:
        child.process.send_signal(signal.SIGTERM)
        child.process.send_signal(signal.SIGCONT)


def stop_all(children: Sequence[Child]) -> None:
    """Terminate every child, wait, then kill. Returns when all have ended."""
    for child in children:
        ask_to_end(child)
    deadline = time.monotonic() + STOP_LIMIT_S
    for child in children:
        try:
            child.process.wait(max(deadline - time.monotonic(), 0.05))
        except subprocess.TimeoutExpired:
            child.process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # blocked by a disk that hangs
                child.process.wait(STOP_LIMIT_S)

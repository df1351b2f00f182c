"""Starts the child processes of a run, reads their output, and ends them by process id."""

import contextlib
import fcntl
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from snakesim_hal.base import arithmetic
from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.base.workers import start_restarting_thread

# A child that has not ended by then is killed, unless the file that it writes still grows.
STOP_TIMEOUT_S = 15.0
MAX_LINES_SHOWN = 15  # of the output of a child that failed
OUTPUT_TAIL_BYTES = 16384  # held in memory, more than MAX_LINES_SHOWN lines usually take
PIPE_BYTES = 2**20  # holds a child's output while this process is frozen
READ_BYTES = 65536


class ProcessOutput:
    """Reads the output of a process from a pipe immediately, so that the process never waits for a disk."""

    def __init__(self, pipe: int, on_output: Callable[[bytes], object]) -> None:
        """Start to read a pipe in another thread.

        Args:
            pipe: File descriptor of the read end.
            on_output: Called with each piece of output, in the other thread.
        """
        self._pipe = pipe
        self._on_output = on_output
        self._tail = b""
        self._thread = start_restarting_thread("words", self._read_pipe)

    def last_lines(self) -> list[str]:
        """Return the last lines of stdout and stderr, once the process has ended."""
        self._thread.join(1.0)
        text = self._tail.decode(errors="replace").strip()
        return text.splitlines()[-MAX_LINES_SHOWN:]

    def _read_pipe(self) -> None:
        with contextlib.suppress(
            OSError
        ):  # the kernel may not allow a larger pipe than the default
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        while output := os.read(self._pipe, READ_BYTES):
            self._tail = (self._tail + output)[-OUTPUT_TAIL_BYTES:]
            self._on_output(output)
        os.close(self._pipe)


@dataclass
class ChildProcess:
    """A child process and its output."""

    name: str
    process: subprocess.Popen[bytes]
    output: ProcessOutput
    written_file: Path | None = None  # which the child completes before it ends
    is_end_requested: bool = False  # by this process, while the child ran
    was_killed: bool = False  # by this process, because it did not end within STOP_TIMEOUT_S

    def measure_written_bytes(self) -> int:
        """Return the size of the file that the child writes; 0 if there is none."""
        if self.written_file is None or not self.written_file.exists():
            return 0
        return self.written_file.stat().st_size

    def describe_exit(self) -> str | None:
        """Describe how the process ended, with its last error message; None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        if self.was_killed:
            return f"{self.name} was killed: it had not ended {STOP_TIMEOUT_S:g} s after the request to end"
        if code < 0:
            return f"{self.name} was ended by {signal.Signals(-code).name}"
        text = f"{self.name} ended with exit code {code}"
        lines = self.output.last_lines()
        error_prefix = f"snakesim {self.name}: "
        if lines and lines[-1].startswith(error_prefix):
            text += f": {lines[-1].removeprefix(error_prefix)}"
        return text


def start_child(
    name: str,
    arguments: Sequence[str],
    on_output: Callable[[bytes], object],
    *,
    pass_fds: Sequence[int] = (),
    extra_env: Mapping[str, str] = MappingProxyType({}),
    written_file: Path | None = None,
) -> ChildProcess:
    """Start a Python module as a child that dies with this process.

    The child gets a session of its own, so that Ctrl-C reaches only the supervisor, which then ends its children in
    order. A SIGINT that arrives while the child's interpreter starts waits until the child has a handler.

    Args:
        name: Name of the child in messages.
        arguments: Name of the module, followed by its command-line arguments.
        on_output: Called with each piece of output of the child, in another thread.
        pass_fds: File descriptors that stay open in the child.
        extra_env: Environment variables of the child, in addition to those of this process.
        written_file: File that the child completes before it ends.
    """
    deterministic_env = {"PYTHONUNBUFFERED": "1", "PYTHONHASHSEED": "0"}
    environment = make_child_environment(
        arithmetic.make_common_arithmetic_env(),
        arithmetic.SINGLE_THREAD_ENV,
        deterministic_env,
        extra_env,
    )
    read_end, write_end = os.pipe()
    # The child inherits the blocked signal.
    old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process = subprocess.Popen(
            make_python_command("-m", *arguments, "--parent", str(os.getpid())),
            stdin=subprocess.DEVNULL,
            stdout=write_end,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            pass_fds=pass_fds,
        )
    except OSError:
        os.close(read_end)
        raise
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)
        os.close(write_end)
    return ChildProcess(name, process, ProcessOutput(read_end, on_output), written_file)


def request_child_end(child: ChildProcess) -> None:
    """Request the end of a running child: send SIGTERM, and SIGCONT so that a frozen child receives it.

    A child that is still starting has no signal handler and ends immediately. It has no data that could be lost.
    """
    if child.process.poll() is None:
        child.is_end_requested = True
        child.process.send_signal(signal.SIGTERM)
        child.process.send_signal(signal.SIGCONT)


def stop_children(children: Sequence[ChildProcess]) -> None:
    """Request the end of every child, wait for STOP_TIMEOUT_S, kill those that still run, and wait for these.

    A child whose file still grows is not killed: a recorder on a busy computer may have messages of many seconds to
    write.
    """
    for child in children:
        request_child_end(child)
    deadline_s = time.monotonic() + STOP_TIMEOUT_S
    for child in children:
        if _wait_for_end(child, deadline_s):
            continue
        child.was_killed = True
        child.process.kill()
        # A disk that hangs may block even a killed process.
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(STOP_TIMEOUT_S)


def _wait_for_end(child: ChildProcess, deadline_s: float) -> bool:
    """Wait until a child ends, and return whether it has ended.

    Args:
        child: Child whose end was requested.
        deadline_s: Monotonic time until which to wait. Then the wait continues as long as the child's file grows within
            each STOP_TIMEOUT_S.
    """
    written_bytes = child.measure_written_bytes()
    timeout_s = max(deadline_s - time.monotonic(), 0.05)
    while True:
        try:
            child.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            previous_bytes, written_bytes = written_bytes, child.measure_written_bytes()
            if written_bytes <= previous_bytes:
                return False
            timeout_s = STOP_TIMEOUT_S
        else:
            return True

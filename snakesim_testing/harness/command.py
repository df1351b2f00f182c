"""Runs the `snakesim` command in real processes, on unused ports of the loopback interface."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import find_processes_of_run, find_run_processes
from snakesim_testing.harness.wait import TIMEOUT_S, wait_until

SNAKESIM_COMMAND = [sys.executable, "-m", "snakesim_operator"]
END_WITH_TESTS = ["setpriv", "--pdeathsig", "KILL"]  # the process ends even if the tests are killed
TIMED_OUT = 124  # the exit code of timeout(1), which `snakesim` does not use
# Variables that `make` passes to its commands.
MAKE_VARIABLES = {"MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES", "MAKELEVEL", "ARGS", "WORKERS"}


@dataclass(frozen=True)
class CompletedRun:
    """The exit code and the output of a command that has ended."""

    code: int
    out: str
    err: str
    duration_s: float = 0.0

    @property
    def printed(self) -> str:
        """Standard output and standard error together."""
        return self.out + self.err


def make_environment(home: Path, **more: str) -> dict[str, str]:
    """Return the environment of the test without the variables of `make`, and with a state folder of its own.

    Args:
        home: The state folder.
        **more: Further variables.
    """
    inherited = {name: value for name, value in os.environ.items() if name not in MAKE_VARIABLES}
    return {**inherited, "XDG_STATE_HOME": str(home), "PYTHONUNBUFFERED": "1", **more}


def snakesim(
    *arguments: str,
    cwd: Path,
    timeout_s: float = TIMEOUT_S,
    extra_env: Mapping[str, str] | None = None,
    command_prefix: Sequence[str] = (),
) -> CompletedRun:
    """Run a command of `snakesim` until it ends, without input.

    Args:
        *arguments: Arguments of the command.
        cwd: Folder in which it runs.
        timeout_s: Time in s after which it is killed; its exit code is then TIMED_OUT.
        extra_env: Variables that are added to its environment.
        command_prefix: Command line that runs it elsewhere, such as in a network namespace.

    Returns:
        Its exit code and output.
    """
    return run_program(
        [*command_prefix, *SNAKESIM_COMMAND, *arguments],
        cwd,
        make_environment(cwd, **(extra_env or {})),
        timeout_s,
    )


def run_program(
    command_line: Sequence[object],
    cwd: Path,
    env: Mapping[str, str] | None = None,
    timeout_s: float = TIMEOUT_S,
    preexec_fn: Callable[[], None] | None = None,
) -> CompletedRun:
    """Run a program until it ends, without input.

    Args:
        command_line: The program and its arguments.
        cwd: Folder in which it runs.
        env: All variables of its environment; None for those of `make_environment(cwd)`.
        timeout_s: Time in s after which it is killed; its exit code is then TIMED_OUT.
        preexec_fn: Function that is called in the child process before the program begins.

    Returns:
        Its exit code and output.
    """
    start_s = time.monotonic()
    try:
        completed = subprocess.run(
            [str(word) for word in command_line],
            cwd=cwd,
            env=make_environment(cwd) if env is None else env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout_s,
            check=False,
            preexec_fn=preexec_fn,
        )
        code = completed.returncode
        out = completed.stdout
        err = completed.stderr
    except subprocess.TimeoutExpired as timeout:
        code = TIMED_OUT
        out = timeout.stdout or b""
        err = (timeout.stderr or b"") + b"\n[did not end within %g s]" % timeout_s
    return CompletedRun(
        code,
        out.decode(errors="replace"),
        err.decode(errors="replace"),
        duration_s=time.monotonic() - start_s,
    )


@dataclass(frozen=True)
class RunningCommand:
    """A `snakesim run` in the background."""

    process: subprocess.Popen[bytes]
    out: Path
    asked_endpoint: str | None
    extra_env: Mapping[str, str] | None
    command_prefix: Sequence[str]

    @property
    def home(self) -> Path:
        """The folder in which the command was started."""
        return self.out.parent

    @property
    def endpoint(self) -> str:
        """The endpoint of the network of the run, which the command prints."""
        return self.asked_endpoint or self._find_printed(r"network: (\S+?),")

    def console(self) -> str:
        """Wait until the run has printed the address of its live console, and return it."""
        return self._find_printed(r"console: (http\S+)")

    def _find_printed(self, pattern: str) -> str:
        wait_until(
            lambda: re.search(pattern, self.printed()) or self.process.poll() is not None,
            f"{pattern!r} from the run",
        )
        match = re.search(pattern, self.printed())
        assert match is not None, self.describe_ending()
        return match[1]

    def describe_ending(self) -> str:
        """Return exit code and last output of the run, for the text of a failure."""
        return f"the run ended with {self.process.returncode}: {self.printed()[-2000:]}"

    def printed(self) -> str:
        """Return everything that the run has printed."""
        return self.out.with_suffix(".printed").read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str, timeout_s: float = TIMEOUT_S) -> None:
        """Wait until the run has printed a text. Fails if the run ends without it."""
        wait_until(
            lambda: text in self.printed() or self.process.poll() is not None,
            f"{text!r} from the run",
            timeout_s,
        )
        assert text in self.printed(), self.describe_ending()

    def run_tool(self, *arguments: str, timeout_s: float = TIMEOUT_S) -> CompletedRun:
        """Run a tool on the same machine with the endpoint of this run."""
        return snakesim(
            *arguments,
            "--endpoint",
            self.endpoint,
            cwd=self.home,
            timeout_s=timeout_s,
            extra_env=self.extra_env,
            command_prefix=self.command_prefix,
        )

    def part(self, name: str) -> int:
        """Return the process id of one part of the run, such as `host` or `control`."""
        return find_run_processes(self.out)[name]

    def parts(self) -> dict[str, int]:
        """Return the process ids of host and services that are alive, by name."""
        parts = ("host", "guidance", "navigation", "control")
        return {name: pid for name, pid in find_run_processes(self.out).items() if name in parts}

    def end(self, timeout_s: float = TIMEOUT_S) -> int:
        """Wait until the run has ended, and return its exit code."""
        return self.process.wait(timeout_s)

    def interrupt(self, timeout_s: float = TIMEOUT_S) -> int:
        """Send SIGINT to the run, as Ctrl-C does, wait until it has ended, and return its exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.end(timeout_s)


@contextmanager
def running_snakesim(
    output_path: Path,
    *arguments: str,
    endpoint: str | None = "free",
    extra_env: Mapping[str, str] | None = None,
    command_prefix: Sequence[str] = (),
) -> Iterator[RunningCommand]:
    """Run `snakesim run` in the background, and kill all of its processes that are left at the end.

    Args:
        output_path: Folder of the run; its output is written beside it.
        *arguments: Arguments of the command.
        endpoint: Endpoint of its network; "free" for an unused port, None to let it choose.
        extra_env: Variables that are added to its environment.
        command_prefix: Command line that runs it elsewhere, such as in a network namespace.
    """
    asked = find_free_endpoint() if endpoint == "free" else endpoint
    network = ["--endpoint", asked] if asked is not None and "--router" not in arguments else []
    with output_path.with_suffix(".printed").open("wb") as output:
        process = subprocess.Popen(
            [
                *command_prefix,
                *END_WITH_TESTS,
                *SNAKESIM_COMMAND,
                "run",
                *arguments,
                "--out",
                str(output_path),
                *network,
            ],
            cwd=output_path.parent,
            env=make_environment(output_path.parent, **(extra_env or {})),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        yield RunningCommand(process, output_path, asked, extra_env, command_prefix)
    finally:
        for pid, _ in find_processes_of_run(output_path):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        if process.poll() is None:
            process.kill()
            process.wait(10)

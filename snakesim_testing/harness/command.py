"""The `snakesim` command, in real processes, on loopback ports of its own."""

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

from snakesim_testing.harness.endpoint import free_endpoint
from snakesim_testing.harness.processes import parts_of, processes_of
from snakesim_testing.harness.wait import LIMIT_S, wait_until

SNAKESIM = [sys.executable, "-m", "snakesim_operator"]
WITH_TESTS = ["setpriv", "--pdeathsig", "KILL"]  # ends when the tests are killed, too
TOO_LONG = 124  # as timeout(1) has it: no exit code of ours
HANDED_DOWN = {"MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES", "MAKELEVEL", "ARGS", "WORKERS"}


@dataclass(frozen=True)
class Ended:
    """A finished command."""

    code: int
    out: str
    err: str
    took_s: float = 0.0

    @property
    def printed(self) -> str:
        """Standard output and standard error together."""
        return self.out + self.err


def environment(home: Path, **more: str) -> dict[str, str]:
    """The caller's environment without what `make` hands down, and with a state folder of the test's own."""
    kept = {name: value for name, value in os.environ.items() if name not in HANDED_DOWN}
    return {**kept, "XDG_STATE_HOME": str(home), "PYTHONUNBUFFERED": "1", **more}


def snakesim(
    *arguments: str,
    cwd: Path,
    limit_s: float = LIMIT_S,
    more: Mapping[str, str] | None = None,
    inside: Sequence[str] = (),
) -> Ended:
    """Run a command to its end. more: of the environment. inside: a prefix that runs it somewhere else."""
    return call([*inside, *SNAKESIM, *arguments], cwd, environment(cwd, **(more or {})), limit_s)


def call(
    typed: Sequence[object],
    cwd: Path,
    env: Mapping[str, str] | None = None,
    limit_s: float = LIMIT_S,
    begin: Callable[[], None] | None = None,
) -> Ended:
    """Run a program to its end, without input.

    Args:
        typed: The program and its arguments.
        cwd: Folder in which it runs.
        env: All of its environment; None: `environment(cwd)`.
        limit_s: Time after which it is killed; its exit code is then TOO_LONG.
        begin: Called in the child process before the program begins.
    """
    start_s = time.monotonic()
    try:
        completed = subprocess.run(
            [str(word) for word in typed],
            cwd=cwd,
            env=environment(cwd) if env is None else env,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=limit_s,
            check=False,
            preexec_fn=begin,
        )
        code = completed.returncode
        out = completed.stdout
        err = completed.stderr
    except subprocess.TimeoutExpired as timeout:
        code = TOO_LONG
        out = timeout.stdout or b""
        err = (timeout.stderr or b"") + b"\n[did not end within %g s]" % limit_s
    return Ended(code, out.decode(errors="replace"), err.decode(errors="replace"), took_s=time.monotonic() - start_s)


@dataclass(frozen=True)
class Running:
    """A `snakesim run` that goes on."""

    process: subprocess.Popen[bytes]
    out: Path
    asked_endpoint: str | None
    more: Mapping[str, str] | None
    inside: Sequence[str]

    @property
    def home(self) -> Path:
        """The folder in which it was started."""
        return self.out.parent

    @property
    def endpoint(self) -> str:
        """The endpoint of its network, as it prints it."""
        return self.asked_endpoint or self._find_printed(r"network: (\S+?),")

    def console(self) -> str:
        """The address of its live console, once it is printed."""
        return self._find_printed(r"console: (http\S+)")

    def _find_printed(self, pattern: str) -> str:
        wait_until(
            lambda: re.search(pattern, self.printed()) or self.process.poll() is not None, f"{pattern!r} from the run"
        )
        found = re.search(pattern, self.printed())
        assert found is not None, self.how_it_ended()
        return found[1]

    def how_it_ended(self) -> str:
        """For the words of a failure."""
        return f"the run ended with {self.process.returncode}: {self.printed()[-2000:]}"

    def printed(self) -> str:
        """All that it has printed."""
        return self.out.with_suffix(".printed").read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str, limit_s: float = LIMIT_S) -> None:
        """Wait until it has printed this text."""
        wait_until(lambda: text in self.printed() or self.process.poll() is not None, f"{text!r} from the run", limit_s)
        assert text in self.printed(), self.how_it_ended()

    def tell(self, *arguments: str, limit_s: float = LIMIT_S) -> Ended:
        """Run a tool on the same machine with the endpoint of this run."""
        where = (*arguments, "--endpoint", self.endpoint)
        return snakesim(*where, cwd=self.home, limit_s=limit_s, more=self.more, inside=self.inside)

    def part(self, name: str) -> int:
        """Process id of one of its parts: `host`, `control`, ..."""
        return parts_of(self.out)[name]

    def parts(self) -> dict[str, int]:
        """Process ids of those of its host and services that live."""
        own = ("host", "guidance", "navigation", "control")
        return {name: pid for name, pid in parts_of(self.out).items() if name in own}

    def end(self, limit_s: float = LIMIT_S) -> int:
        """Wait for its exit code."""
        return self.process.wait(limit_s)

    def interrupt(self, limit_s: float = LIMIT_S) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.end(limit_s)


@contextmanager
def running(
    out: Path,
    *arguments: str,
    endpoint: str | None = "free",
    more: Mapping[str, str] | None = None,
    inside: Sequence[str] = (),
) -> Iterator[Running]:
    """Run `snakesim run` in the background, and kill all of its processes that are left at the end.

    Args:
        out: Folder of the run; its output is written beside it.
        *arguments: Arguments of the command.
        endpoint: Endpoint of its network; "free" for an unused port, None to let it choose.
        more: Variables that are added to its environment.
        inside: Command line that runs it elsewhere, such as in a network namespace.
    """
    asked = free_endpoint() if endpoint == "free" else endpoint
    network = ["--endpoint", asked] if asked is not None and "--router" not in arguments else []
    with out.with_suffix(".printed").open("wb") as output:
        process = subprocess.Popen(
            [*inside, *WITH_TESTS, *SNAKESIM, "run", *arguments, "--out", str(out), *network],
            cwd=out.parent,
            env=environment(out.parent, **(more or {})),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        yield Running(process, out, asked, more, inside)
    finally:
        for pid, _ in processes_of(out):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        if process.poll() is None:
            process.kill()
            process.wait(10)

"""Drives the real `snakesim` command, in real processes, on loopback ports of its own."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_operator.results.record import SUMMARY
from snakesim_operator.results.summary import RunSummary
from tests.harness.endpoint import free_endpoint
from tests.harness.processes import parts_of
from tests.harness.wait import wait_until

SNAKESIM = [sys.executable, "-m", "snakesim_operator"]
LIMIT_S = 90.0


@dataclass(frozen=True)
class Ended:
    """A finished command."""

    code: int
    out: str
    err: str


HANDED_DOWN = {"MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES", "MAKELEVEL", "ARGS", "WORKERS", "QUICK"}


def environment(home: Path, **more: str) -> dict[str, str]:
    """The caller's environment without what `make` hands down, and with a state folder of the test's own."""
    kept = {name: value for name, value in os.environ.items() if name not in HANDED_DOWN}
    return {**kept, "XDG_STATE_HOME": str(home), "PYTHONUNBUFFERED": "1", **more}


def snakesim(*arguments: str, cwd: Path, limit_s: float = LIMIT_S, more: dict[str, str] | None = None) -> Ended:
    """Run a command to its end."""
    done = subprocess.run(
        [*SNAKESIM, *arguments],
        cwd=cwd,
        env=environment(cwd, **(more or {})),
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )
    return Ended(done.returncode, done.stdout, done.stderr)


def run_to_summary(out: Path, *arguments: str, **more: str) -> tuple[Ended, RunSummary]:
    """`snakesim run ... --out out`, and the summary that it left."""
    network = [] if "--router" in arguments else ["--endpoint", free_endpoint()]
    ended = snakesim("run", *arguments, "--out", str(out), *network, cwd=out.parent, more=more)
    assert (out / SUMMARY).is_file(), ended.out + ended.err
    return ended, msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)


@dataclass(frozen=True)
class Running:
    """A run in progress."""

    process: subprocess.Popen[str]
    out: Path
    endpoint: str

    def part(self, name: str) -> int:
        """Process id of one of its parts: `host`, `control`, ..."""
        return parts_of(self.out)[name]

    def wait_for(self, what: str, limit_s: float = LIMIT_S) -> None:
        """Until the run's output contains a text."""
        wait_until(lambda: what in self.said(), f"{what!r} in the run's output", limit_s)

    def said(self) -> str:
        """What the command has printed so far."""
        return self.out.with_suffix(".said").read_text(encoding="utf-8")

    def console(self) -> str:
        """The address of its live console, once it is told."""
        self.wait_for("console: http")
        return next(line.split()[1] for line in self.said().splitlines() if line.startswith("console: "))

    def end(self, limit_s: float = LIMIT_S) -> int:
        """Wait for the exit code."""
        return self.process.wait(limit_s)


@contextmanager
def running(out: Path, *arguments: str) -> Iterator[Running]:
    """A `snakesim run` in the background; whatever is left of it at the end is killed."""
    endpoint = free_endpoint()
    with out.with_suffix(".said").open("w") as said:
        process = subprocess.Popen(
            [*SNAKESIM, "run", *arguments, "--out", str(out), "--endpoint", endpoint],
            cwd=out.parent,
            env=environment(out.parent),
            stdout=said,
            stderr=subprocess.STDOUT,
            text=True,
        )
    run = Running(process, out, endpoint)
    try:
        yield run
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            process.wait(10)

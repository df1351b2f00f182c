"""Drives the real `snakesim` command, and reads what it leaves."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

from snakesim_operator.results.run_reader import SUMMARY
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.harness.command import LIMIT_S, SNAKESIM, Ended, Running, call, environment, running, snakesim
from snakesim_testing.harness.endpoint import free_endpoint
from snakesim_testing.harness.processes import nothing_left

TOO_SLOW = "this computer is too slow: "
__all__ = [
    "LIMIT_S",
    "SNAKESIM",
    "TOO_SLOW",
    "Ended",
    "Running",
    "armed_run",
    "background",
    "call",
    "environment",
    "run_to_summary",
    "running",
    "snakesim",
    "summary_of",
]


@contextmanager
def background(
    home: Path, *arguments: str, stdin: int | None = None, program: Sequence[str] = SNAKESIM
) -> Iterator[subprocess.Popen[str]]:
    """A command, of ours or of another program, in the background, killed at the end."""
    with subprocess.Popen(
        [*program, *arguments], cwd=home, env=environment(home), stdin=stdin, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def armed_run(out: Path, *arguments: str) -> Iterator[Running]:
    """A run in the background, once its first line of progress shows that it is armed; it leaves no process behind."""
    with running(out, *arguments) as run:
        run.wait_for(" s  ")
        yield run
        if run.process.poll() is not None:
            nothing_left(out)


def run_to_summary(out: Path, *arguments: str, **more: str) -> tuple[Ended, RunSummary]:
    """`snakesim run ... --out out`, and the summary that it left, and no process."""
    network = [] if "--router" in arguments else ["--endpoint", free_endpoint()]
    ended = snakesim("run", *arguments, "--out", str(out), *network, cwd=out.parent, more=more)
    assert (out / SUMMARY).is_file(), ended.printed
    nothing_left(out)
    return ended, summary_of(out)


def summary_of(out: Path) -> RunSummary:
    """What a run left."""
    return msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)

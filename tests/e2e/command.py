"""Drives the real `snakesim` command, and reads what it leaves."""

import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

from snakesim_hal.process import SERVICE_PRIORITY, set_realtime_priority
from snakesim_operator.results.record import SUMMARY
from snakesim_operator.results.summary import RunSummary
from tests.harness.command import LIMIT_S, SNAKESIM, Ended, Running, environment, running, snakesim
from tests.harness.endpoint import free_endpoint

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
]


def call(
    typed: Sequence[object],
    cwd: Path,
    env: Mapping[str, str] | None = None,
    limit_s: float = LIMIT_S,
    *,
    urgent: bool = False,
) -> Ended:
    """Any program to its end. env: all of its environment.

    urgent: as a run's own control, where that is allowed: a busy computer holds it up otherwise.
    """
    done = subprocess.run(
        [str(word) for word in typed],
        cwd=cwd,
        env=environment(cwd) if env is None else env,
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
        preexec_fn=(lambda: set_realtime_priority(SERVICE_PRIORITY)) if urgent else None,
    )
    return Ended(done.returncode, done.stdout, done.stderr)


@contextmanager
def background(home: Path, *arguments: str, stdin: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """A command in the background, killed at the end."""
    with subprocess.Popen(
        [*SNAKESIM, *arguments], cwd=home, env=environment(home), stdin=stdin, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def armed_run(out: Path, *arguments: str) -> Iterator[Running]:
    """A run in the background, once its first line of progress tells that it is armed."""
    with running(out, *arguments) as run:
        run.wait_for(" s  ")
        yield run


def run_to_summary(out: Path, *arguments: str, **more: str) -> tuple[Ended, RunSummary]:
    """`snakesim run ... --out out`, and the summary that it left."""
    network = [] if "--router" in arguments else ["--endpoint", free_endpoint()]
    ended = snakesim("run", *arguments, "--out", str(out), *network, cwd=out.parent, more=more)
    assert (out / SUMMARY).is_file(), ended.said
    return ended, msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)

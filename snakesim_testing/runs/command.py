"""Runs the `snakesim` command in processes of its own, and reads the files of its runs."""

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.harness.command import (
    SNAKESIM_COMMAND,
    TIMEOUT_S,
    CompletedRun,
    RunningCommand,
    make_environment,
    run_program,
    running_snakesim,
    snakesim,
)
from snakesim_testing.harness.endpoint import find_free_endpoint
from snakesim_testing.harness.processes import assert_no_process_left

TOO_SLOW = "this computer is too slow: "
__all__ = [
    "SNAKESIM_COMMAND",
    "TIMEOUT_S",
    "TOO_SLOW",
    "CompletedRun",
    "RunningCommand",
    "make_environment",
    "read_summary",
    "run_in_background",
    "run_program",
    "run_to_summary",
    "running_armed_snakesim",
    "running_snakesim",
    "snakesim",
]


@contextmanager
def run_in_background(
    home: Path, *arguments: str, stdin: int | None = None, program: Sequence[str] = SNAKESIM_COMMAND
) -> Iterator[subprocess.Popen[str]]:
    """Run a command in the background, and kill it at the end of the context.

    Args:
        home: Folder in which the command runs.
        *arguments: Arguments of the program.
        stdin: File descriptor or subprocess constant for the input.
        program: Command line of the program.
    """
    with subprocess.Popen(
        [*program, *arguments],
        cwd=home,
        env=make_environment(home),
        stdin=stdin,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def running_armed_snakesim(out: Path, *arguments: str) -> Iterator[RunningCommand]:
    """Run `snakesim run` in the background, and yield it once it is armed. Fails if it leaves a process behind."""
    with running_snakesim(out, *arguments) as run:
        run.wait_for(" s  ")
        yield run
        if run.process.poll() is not None:
            assert_no_process_left(out)


def run_to_summary(out: Path, *arguments: str, **extra_env: str) -> tuple[CompletedRun, RunSummary]:
    """Run `snakesim run` to its end, and fail if it leaves a process behind.

    Args:
        out: Folder for the files of the run.
        *arguments: Arguments of `snakesim run`.
        **extra_env: Further environment variables.

    Returns:
        The completed command and the summary of the run.
    """
    network = [] if "--router" in arguments else ["--endpoint", find_free_endpoint()]
    completed = snakesim(
        "run", *arguments, "--out", str(out), *network, cwd=out.parent, extra_env=extra_env
    )
    assert (out / SUMMARY_FILENAME).is_file(), completed.printed
    assert_no_process_left(out)
    return completed, read_summary(out)


def read_summary(out: Path) -> RunSummary:
    """Return the summary of a run, from its folder."""
    return msgspec.json.decode((out / SUMMARY_FILENAME).read_bytes(), type=RunSummary)

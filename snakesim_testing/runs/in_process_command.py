"""Runs the `snakesim` command in the process of the test, for tests that need no other processes and no network."""

import contextlib
import io
from pathlib import Path

from snakesim_operator.cli import main
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.runs.command import CompletedRun, RunningCommand, read_summary


def snakesim(*arguments: str, cwd: Path) -> CompletedRun:
    """Run a command to its end, with a folder as the working directory.

    Args:
        *arguments: Arguments of the command.
        cwd: The working directory.

    Returns:
        Exit code and output of the command.
    """
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(arguments)
        except SystemExit as exit_request:  # argparse exits after a usage error and after --help
            code = int(exit_request.code or 0)
    return CompletedRun(code, out.getvalue(), err.getvalue())


def run_command_for_robot(run: RunningCommand, *arguments: str) -> CompletedRun:
    """Run a command to its end, with the endpoint of a running robot."""
    return snakesim(*arguments, "--endpoint", run.endpoint, cwd=run.home)


def run_to_summary(out: Path, *arguments: str) -> tuple[CompletedRun, RunSummary]:
    """Run `snakesim run --in-process` to its end, and return the completed command and the summary of the run."""
    completed = snakesim("run", *arguments, "--in-process", "--out", str(out), cwd=out.parent)
    assert (out / SUMMARY_FILENAME).is_file(), completed.out + completed.err
    return completed, read_summary(out)

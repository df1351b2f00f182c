"""The `snakesim` command and whole runs of it in this process, for tests that need no processes and no network."""

import contextlib
import io
from pathlib import Path

from snakesim_operator.cli import main
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.runs.command import CompletedRun, RunningCommand, read_summary


def snakesim(*arguments: str, cwd: Path) -> CompletedRun:
    """Run a command to its end, as typed in a folder."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(arguments)
        except SystemExit as ended:  # of argparse
            code = int(ended.code or 0)
    return CompletedRun(code, out.getvalue(), err.getvalue())


def run_command_for_robot(run: RunningCommand, *arguments: str) -> CompletedRun:
    """The same, with the endpoint of a run."""
    return snakesim(*arguments, "--endpoint", run.endpoint, cwd=run.home)


def run_to_summary(out: Path, *arguments: str) -> tuple[CompletedRun, RunSummary]:
    """`snakesim run ... --in-process --out out`, and the summary that it left."""
    ended = snakesim("run", *arguments, "--in-process", "--out", str(out), cwd=out.parent)
    assert (out / SUMMARY_FILENAME).is_file(), ended.out + ended.err
    return ended, read_summary(out)

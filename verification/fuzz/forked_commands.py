"""Runs many `snakesim` commands, each within limits, in children of one process that has imported everything once.

`start_command_server` starts that process as `python -m verification.fuzz.forked_commands`. It reads one request a
line, as JSON: a folder and the arguments of a command. It forks a child that is the command, and answers with one line.

Importing costs a command more CPU time than a small recording does, so the server imports what the commands will
import. A module that is missing in its list costs time, and changes no result.
"""

import atexit
import contextlib
import gc
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import NoReturn

# Of address space, above that of the imports. The renderer of a film takes most of it.
MAX_GROWTH_MB = 1200
MAX_CPU_S = 30
POLL_PERIOD_S = 0.005
ENDLESS_COMMANDS = ("console",)  # which run until they are interrupted
RUNNING_TEXT = b"console: "  # what such a command prints once it runs
STDOUT_FILENAME = "out"
STDERR_FILENAME = "err"

# What the commands import when they run. The optional packages among them may be missing.
COMMAND_MODULES = (
    "mujoco.egl",
    "numpy.ma",
    "pandas",
    "PIL.GifImagePlugin",
    "pyarrow.pandas_compat",
    "pyarrow.parquet",
    "rich.table",
    "snakesim_gnc.control.obstacle_triplet.controller",
    "snakesim_gnc.control.service",
    "snakesim_gnc.guidance.surveyed_source",
    "snakesim_gnc.guidance.service",
    "snakesim_gnc.navigation.service",
    "snakesim_hal.faults.injector",
    "snakesim_operator.cli",
    "snakesim_operator.features.console.command",
    "snakesim_operator.features.console.display_loop",
    "snakesim_operator.features.console.page.signals_page",
    "snakesim_operator.features.console.robot_data.run_playback",
    "snakesim_operator.playback.control",
    "snakesim_operator.playback.export",
    "snakesim_operator.playback.info",
    "snakesim_operator.playback.lerobot",
    "snakesim_operator.playback.play",
    "snakesim_operator.playback.video",
    "snakesim_operator.results.compare",
    "snakesim_operator.results.report",
    "snakesim_sim_backend.film",
)
COMMAND_PLUGINS = "snakesim.commands"  # the group of entry points with further commands


@dataclass(frozen=True, kw_only=True)
class CommandOutcome:
    """How a command ended, and what it printed and used."""

    exit_code: int  # negative for the signal that ended the command
    stdout: str
    stderr: str
    cpu_s: float
    peak_mb: float


RunCommand = Callable[..., CommandOutcome]


@contextlib.contextmanager
def start_command_server(state_home: Path) -> Iterator[RunCommand]:
    """Start the process that forks, and end it with the `with` block.

    Args:
        state_home: The folder in which commands keep what outlives a run.

    Yields:
        A function that takes a folder and the arguments of a command, runs the command there, and returns its outcome.
    """
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "XDG_STATE_HOME": str(state_home)}
    command = [sys.executable, "-m", "verification.fuzz.forked_commands"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as server:
        requests = server.stdin
        answers = server.stdout
        assert requests is not None
        assert answers is not None

        def run_command(folder: Path, *arguments: str) -> CommandOutcome:
            print(json.dumps([str(folder), *arguments]), file=requests, flush=True)
            return CommandOutcome(**json.loads(answers.readline()))

        yield run_command


def main() -> None:
    """Serve requests until the end of the input."""
    ending = _CommandEnding()
    # Exit handlers run in the reverse order, so this one runs after those of all modules.
    atexit.register(ending.skip_freeing_modules)
    _import_command_modules()
    # Without this, each child would copy the memory of all modules in order to collect garbage in it.
    gc.collect()
    gc.freeze()
    max_address_space_bytes = _read_address_space_bytes() + MAX_GROWTH_MB * 2**20
    for line in sys.stdin:
        folder_name, *arguments = json.loads(line)
        folder = Path(folder_name)
        child = os.fork()
        if child == 0:
            _set_up_child(folder, max_address_space_bytes)
            ending.run_command(arguments)
        if arguments[0] in ENDLESS_COMMANDS:
            _terminate_once_running(child, folder / STDOUT_FILENAME)
        print(json.dumps(asdict(_await_end(child, folder))), flush=True)


def _import_command_modules() -> None:
    for name in COMMAND_MODULES:
        # A command that needs a missing package reports that itself.
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for plugin in entry_points(group=COMMAND_PLUGINS):
        with contextlib.suppress(ImportError):
            plugin.load()


def _read_address_space_bytes() -> int:
    pages, *_ = Path("/proc/self/statm").read_text().split()
    return int(pages) * resource.getpagesize()


def _set_up_child(folder: Path, max_address_space_bytes: int) -> None:
    """Enter the folder, write the output into files there, and limit memory and CPU time."""
    os.chdir(folder)
    for descriptor, filename in ((0, os.devnull), (1, STDOUT_FILENAME), (2, STDERR_FILENAME)):
        file = os.open(filename, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(file, descriptor)
    resource.setrlimit(resource.RLIMIT_AS, (max_address_space_bytes, max_address_space_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))


class _CommandEnding:
    """Runs a command in a child, and ends the child as the command ends its own process, but for its last step.

    Threads are awaited, exit handlers run, and output is flushed. In the last step, the interpreter would free all
    modules, and the child would have to copy their memory for that. It would take as long as a short command.
    """

    def __init__(self) -> None:
        self._runs_command = False
        self._exit_code: int | str | None = 1  # that of an uncaught exception

    def run_command(self, arguments: list[str]) -> NoReturn:
        """Run the command, and exit with its code."""
        from snakesim_operator.cli import main as run_snakesim

        self._runs_command = True
        try:
            sys.exit(run_snakesim(arguments))
        except SystemExit as exit_request:
            self._exit_code = exit_request.code
            raise

    def skip_freeing_modules(self) -> None:
        """End a child at once. The server itself ends as usual."""
        if not self._runs_command:
            return
        sys.stdout.flush()
        sys.stderr.flush()
        if self._exit_code is None:
            os._exit(0)
        os._exit(self._exit_code if isinstance(self._exit_code, int) else 1)


def _await_end(child: int, folder: Path) -> CommandOutcome:
    """Wait until a child has ended, and return how it ended."""
    _, status, usage = os.wait4(child, 0)
    return CommandOutcome(
        exit_code=os.waitstatus_to_exitcode(status),
        stdout=(folder / STDOUT_FILENAME).read_text(errors="replace"),
        stderr=(folder / STDERR_FILENAME).read_text(errors="replace"),
        cpu_s=usage.ru_utime + usage.ru_stime,
        peak_mb=usage.ru_maxrss / 1024,
    )


def _terminate_once_running(child: int, stdout_path: Path) -> None:
    """Terminate a child when it prints that it runs until it is interrupted. Return at once if it has ended."""
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if stdout_path.exists() and RUNNING_TEXT in stdout_path.read_bytes():
            os.kill(child, signal.SIGTERM)
            return
        time.sleep(POLL_PERIOD_S)


if __name__ == "__main__":
    main()

"""Runs scenarios in this process, or in several processes as `snakesim run` does, and loads runs from the disk."""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from snakesim.configuration import load_and_validate_config, make_overrides
from snakesim.controllers import ControllerArgument, resolve_controller
from snakesim.result import Result
from snakesim_hal.base.errors import ConfigError, ControllerError, SnakesimError, shorten
from snakesim_hal.model.plugins import CONTROLLERS, register_plugin_temporarily
from snakesim_hal.model.scenario import KeyOverride, RunConfig
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary, summarize_run
from snakesim_operator.run.conclusion import EXIT_INTERRUPTED
from snakesim_operator.run.in_process import simulate
from snakesim_operator.run.run import RunRequest
from snakesim_operator.run.run import run_in_processes as run_processes


def run(
    scenario: str | os.PathLike[str],
    *,
    controller: ControllerArgument | None = None,
    duration: float | None = None,
    seed: int | None = None,
    backend: str | None = None,
    set: Mapping[str, Any] | None = None,
    out: str | os.PathLike[str] | None = None,
    processes: bool = False,
) -> Result:
    """Run a scenario, and return its result.

    Args:
        scenario: Name of a shipped scenario, or path of a scenario file or of a run's config.json.
        controller: A shipped name, a path "./file.py:Class", a controller class, or a function
            f(time_s, joints) -> angles_rad. None takes the scenario's controller.
        duration: Robot time in s. None takes the scenario's duration.
        seed: Seed of all random numbers. None takes the scenario's seed.
        backend: Name of a backend. None takes the scenario's backend.
        set: Other values of the scenario by their dotted keys, as in `snakesim run --set`.
        out: Folder for the files that `snakesim run` writes. None keeps none.
        processes: Whether HAL host and services run in processes of their own, in any clock mode. A backend that
            moves a real robot needs this.

    Returns:
        The result, also of a run that ended with a fault: `Result.status` is how it ended.

    Raises:
        ConfigError: An argument is wrong. Nothing was run.
        ControllerError: The controller raised an exception, or returned something that is not allowed.
        SnakesimError: The run could not begin.
    """
    if not isinstance(scenario, str | os.PathLike):
        raise ConfigError(
            f"run({scenario!r:.60}): give a scenario's name, such as 'triplet', or the path of its file",
            code="python/invalid-argument",
        )
    overrides = make_overrides(set, duration_s=duration, seed=seed, backend=backend)
    with contextlib.ExitStack() as opened:
        if controller is not None:
            name, plugin = resolve_controller(controller)
            overrides.insert(0, KeyOverride("controller", name, f"controller={shorten(name)}"))
            if plugin is not None:
                if processes:
                    raise ConfigError(
                        f"controller={name.removeprefix('program:')}: processes of their own cannot reach an object of "
                        "this program; save it in a file, and give its path, such as controller='./mine.py:Mine'",
                        code="python/invalid-argument",
                    )
                opened.enter_context(register_plugin_temporarily(CONTROLLERS, name, plugin))
        config = load_and_validate_config(os.fspath(scenario), overrides, processes=processes)
        folder = None if out is None else Path(out)
        if processes:
            return _run_in_processes(config, folder)
        return _run_here(config, folder)


def load(path: str | os.PathLike[str]) -> Result:
    """Load the result of a run from the disk.

    Args:
        path: The folder that `snakesim run` wrote, or a recording (MCAP).

    Returns:
        The result. Its summary is computed again, as `snakesim recording report` does.

    Raises:
        ConfigError: It is neither of both, or damaged.
    """
    record = RunRecord.load(Path(path))
    return Result(record, summarize_run(record, record.ending))


def _run_here(config: RunConfig, out: Path | None) -> Result:
    """Run in this process. Raises ControllerError, with the exception of the controller as its cause."""
    simulated = simulate(config, out)
    failure = simulated.control_failure
    if failure is None:
        return Result(simulated.record, simulated.summary)
    try:
        raise ControllerError(failure.message) from failure.cause
    finally:
        # The traceback of the cause holds this function's frame, so nothing in the frame may hold the cause.
        del simulated, failure


def _run_in_processes(config: RunConfig, out: Path | None) -> Result:
    """Run in several processes. Raises SnakesimError when the run leaves no record."""
    with TemporaryDirectory(prefix="snakesim-") as scratch:
        folder = out or Path(scratch) / "run"
        if run_processes(RunRequest(config, out=folder)) == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        if not (folder / SUMMARY_FILENAME).is_file():
            raise SnakesimError("the run left no record; see the output of its processes above")
        summary = msgspec.json.decode((folder / SUMMARY_FILENAME).read_bytes(), type=RunSummary)
        return Result(RunRecord.load(folder), summary)

"""Runs of scenarios: in this process, or in processes of their own, as `snakesim run` has them."""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from snakesim.configuration import checked, overrides_of
from snakesim.controllers import Given, named
from snakesim.result import Result
from snakesim_hal.base.errors import ConfigError, ControllerError, SnakesimError, short
from snakesim_hal.model.plugins import CONTROLLERS, offered
from snakesim_hal.model.scenario import Override, RunConfig
from snakesim_operator.results.record import SUMMARY, RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.conclusion import INTERRUPTED
from snakesim_operator.run.in_process import simulate
from snakesim_operator.run.run import RunRequest
from snakesim_operator.run.run import run as run_processes


def run(
    scenario: str | os.PathLike[str],
    *,
    controller: Given | None = None,
    duration: float | None = None,
    seed: int | None = None,
    backend: str | None = None,
    set: Mapping[str, Any] | None = None,
    out: str | os.PathLike[str] | None = None,
    processes: bool = False,
) -> Result:
    """Run a scenario and return what came of it, also if that is a fault: `Result.ended` says how it ended.

    scenario: shipped name, or path of a scenario or of a run's config.json. duration: s of robot time. set: any other
    value by its dotted key, as `--set` takes them. out: folder for what `snakesim run` leaves; None keeps nothing.
    processes: host and services in processes of their own, at any clock mode; a backend that moves a real robot needs
    it.

    Raises ConfigError for wrong input, before anything runs; ControllerError when the controller raises, or answers
    what is not allowed; SnakesimError when a run cannot begin.
    """
    if not isinstance(scenario, str | os.PathLike):
        raise ConfigError(f"run({scenario!r:.60}): give a scenario's name, such as 'triplet', or the path of its file")
    overrides = overrides_of(set, duration_s=duration, seed=seed, backend=backend)
    with contextlib.ExitStack() as opened:
        if controller is not None:
            name, plugin = named(controller)
            overrides.insert(0, Override("controller", name, f"controller={short(name)}"))
            if plugin is not None:
                if processes:
                    raise ConfigError(
                        f"controller={name.removeprefix('program:')}: processes of their own cannot reach an object of "
                        "this program; save it in a file, and give its path, such as controller='./mine.py:Mine'"
                    )
                opened.enter_context(offered(CONTROLLERS, name, plugin))
        config = checked(os.fspath(scenario), overrides, processes=processes)
        folder = None if out is None else Path(out)
        return _in_processes(config, folder) if processes else _in_this_process(config, folder)


def _in_this_process(config: RunConfig, out: Path | None) -> Result:
    found = simulate(config, out)
    failure = found.control_failure
    if failure is None:
        return Result(found.record, found.summary)
    try:
        raise ControllerError(failure.message) from failure.cause
    finally:
        # The traceback of the cause holds this function's frame, so nothing in the frame may hold the cause.
        del found, failure


def _in_processes(config: RunConfig, out: Path | None) -> Result:
    with TemporaryDirectory(prefix="snakesim-") as kept:
        folder = out or Path(kept) / "run"
        if run_processes(RunRequest(config, out=folder)) == INTERRUPTED:
            raise KeyboardInterrupt
        if not (folder / SUMMARY).is_file():
            raise SnakesimError("the run left no record; what its processes said stands above")
        summary = msgspec.json.decode((folder / SUMMARY).read_bytes(), type=RunSummary)
        return Result(RunRecord.load(folder), summary)

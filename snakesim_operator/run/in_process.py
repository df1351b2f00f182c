"""Runs without processes or a network: `snakesim run --in-process`, and `simulate` for programs.

    from snakesim_hal.model.scenario import load, parse_set
    from snakesim_operator.run.in_process import simulate

    result = simulate(load("triplet", [parse_set("seed=3"), parse_set("duration_s=5")]).config)
    result.summary.path_distance_m, result.record.angle_rad

The run takes as long as its computing. Several at a time go into processes of their own, such as a ProcessPoolExecutor.
"""

import contextlib
import io
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from snakesim_hal.errors import ConfigError
from snakesim_hal.host.recorder import Recorder
from snakesim_hal.host_process import record_of
from snakesim_hal.in_process import InProcessRun, check
from snakesim_hal.model.plugin_check import check_plugins
from snakesim_hal.model.scenario import RunConfig, write
from snakesim_hal.terminal import complain, say
from snakesim_operator.results.advance import GoalWatch
from snakesim_operator.results.record import CONFIG, RunRecord
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.conclusion import Outcome, conclude, explain, leave
from snakesim_operator.run.ending import Ending, interruptible
from snakesim_operator.run.progress import Progress
from snakesim_operator.run.run import opened_files
from snakesim_operator.run.run_files import RunFiles
from snakesim_operator.run.telemetry import Telemetry

WORDS = "run.log"  # what the parts of the run say
TAKEN_EVERY = 50  # turns


@dataclass(frozen=True)
class Result:
    """A run that is over; `summary.ended` says how."""

    record: RunRecord  # every tick, and what control and guidance told
    summary: RunSummary


def simulate(config: RunConfig, out: Path | None = None, *, until_goal: bool = False) -> Result:
    """Run a configuration. out: folder for what a run leaves, the report too; None keeps nothing.

    until_goal: a run whose mission has a goal is complete soon after that is reached.
    Raises SnakesimError when it cannot begin. A run that ends early is a result like others.
    """
    config, ending = check_plugins(config), Ending()
    with contextlib.ExitStack() as opened:
        if out is None:
            folder = Path(opened.enter_context(TemporaryDirectory(prefix="snakesim-")))
            write(config, folder / CONFIG)
            files = RunFiles(folder, complain)
        else:
            files, _ = opened.enter_context(opened_files(config, out))
        if files.folder is None:
            raise ConfigError(f"{out} cannot be written to; choose another folder")
        opened.callback(files.close)
        run = _go(config, files, ending, None, until_goal=until_goal)
        explain(ending, record_of(run.host), config)
        return Result(*leave(files, files.folder, ending, _outcome(run), report=out is not None))


def run_in_process(config: RunConfig, out: Path | None, *, until_goal: bool = False) -> int:
    """`snakesim run --in-process`. Exit code: as of a run in processes. until_goal: as of `simulate`."""
    check(config)
    ending = Ending()
    with opened_files(config, out) as (files, _):
        say(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander}, in one process")
        with interruptible(ending), Progress(config) as progress:
            run = _go(config, files, ending, progress, until_goal=until_goal)
        return conclude(config, files, ending, _outcome(run))


def _outcome(run: InProcessRun) -> Outcome:
    return Outcome(record_of(run.host), run.host.description)


def _go(
    config: RunConfig, files: RunFiles, ending: Ending, progress: Progress | None, *, until_goal: bool
) -> InProcessRun:
    words = _Words(files)
    with contextlib.redirect_stderr(words), InProcessRun(config) as run:
        host, telemetry = run.host, Telemetry(run.network.session(), files)
        watch = GoalWatch(config, host.description)
        with Recorder(host.black_box, host.description, partial(record_of, host), files.folder):
            for turn, _ in enumerate(run.turns()):
                if turn % TAKEN_EVERY == 0:
                    telemetry.take_in()
                    if progress is not None:
                        progress.show(host.status(), telemetry.latest, armed=host.authority.arming > 0)
                    if until_goal and watch.reached(host.black_box):
                        host.complete()
                if ending.interrupted:
                    run.stop()
            telemetry.take_in()
    for failure in run.failed:
        ending.because(failure)
    return run


class _Words(io.TextIOBase):
    """Takes what is printed to stderr into the run's folder."""

    def __init__(self, files: RunFiles) -> None:
        self._files = files

    def write(self, text: str) -> int:
        """From any thread."""
        self._files.append(WORDS, text.encode(errors="replace"))
        return len(text)

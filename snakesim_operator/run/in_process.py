"""Runs without processes or a network: `snakesim run --in-process`, and `simulate` for programs.

    from snakesim_hal.model.scenario import load, parse_set
    from snakesim_operator.run.in_process import simulate

    result = simulate(load("triplet", [parse_set("seed=3"), parse_set("duration_s=5")]).config)
    result.summary.path_distance_m, result.record.angle_rad

The run takes as long as its computing. Several at a time go into processes of their own, such as a ProcessPoolExecutor.
"""

import contextlib
import io
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from snakesim_hal.base.arithmetic import is_pinned
from snakesim_hal.base.errors import ConfigError, ControllerError, SnakesimError
from snakesim_hal.base.step_limit import Pulse
from snakesim_hal.base.terminal import print_stderr, say
from snakesim_hal.model.plugins import anything_offered
from snakesim_hal.model.scenario import CONTROL, RunConfig, write
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.programs.host_program import record_of
from snakesim_hal.programs.preflight import check_plugins
from snakesim_hal.programs.single_process import InProcessRun, check
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.base import extras
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.results.metrics.advance import GoalWatch
from snakesim_operator.results.record import CONFIG, RunRecord
from snakesim_operator.results.recording_contents import SERVICE_STREAMS
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.conclusion import Outcome, conclude, explain, write_results
from snakesim_operator.run.ending import Ending, interruptible
from snakesim_operator.run.pinned_process import call_pinned
from snakesim_operator.run.progress import Progress
from snakesim_operator.run.run import check_recorder, opened_files
from snakesim_operator.run.run_files import RunFiles

if TYPE_CHECKING:
    from snakesim_operator.recording.recording import Recording

WORDS = "run.log"  # what the parts of the run say
TAKEN_EVERY = 50  # turns


class ChildTracebackError(Exception):
    """Stands for an exception of a child process; its text is the traceback there."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


@dataclass(frozen=True)
class ControlFailure:
    """Why control could not go on."""

    message: str
    cause: BaseException | None  # what the controller raised; None: its answer was not allowed

    @staticmethod
    def of(error: SnakesimError | None) -> "ControlFailure | None":
        """Return the failure of an error that has ended control."""
        if error is None:
            return None
        return ControlFailure(str(error), error.__cause__ if isinstance(error, ControllerError) else error)

    def __reduce__(self) -> Any:
        """Pickle the traceback as text: frames stay in their process."""
        if self.cause is None:
            return ControlFailure, (self.message, None)
        text = "".join(traceback.format_exception(self.cause))
        return ControlFailure, (self.message, ChildTracebackError(text))


@dataclass(frozen=True)
class Result:
    """A run that is over; `summary.ended` says how."""

    record: RunRecord  # every tick, and what control and guidance reported
    summary: RunSummary
    gave_up: bool = False  # it was ended because it was stuck
    control_failure: ControlFailure | None = None  # None: control went on to the end


def simulate(
    config: RunConfig,
    out: Path | None = None,
    *,
    until_goal: bool = False,
    give_up_s: float | None = None,
    turn_limit_s: float | None = None,
) -> Result:
    """Run a configuration. out: folder for what a run leaves, the report too; None keeps nothing.

    until_goal: a run whose mission has a goal is complete soon after that is reached; give_up_s: and after so much
    robot time without 3 cm of advance towards it. turn_limit_s: wall time that a part of the run may take in one tick,
    60 s by default, or `start_limit_s` if that is longer.
    Raises SnakesimError when it cannot begin. A run that ends early is a result like others.

    A program that has imported NumPy already may have bound it to other processor code than `snakesim run` has; then
    the run is computed in a child process, so that its digest is the same. `snakesim_hal.base.arithmetic.pin()` before
    the first import of NumPy keeps it in this process. So does a plugin that the program offers itself: then the digest
    may be its computer's own (`summary.own_arithmetic`).
    """
    if not isinstance(config, RunConfig):
        raise ConfigError(
            f"simulate() takes a RunConfig, not {config!r:.60}; `snakesim.run` takes a scenario's name or path"
        )
    if not is_pinned() and not anything_offered():  # what this program offers, a child would not have
        return call_pinned(
            simulate,
            config=config,
            out=out,
            until_goal=until_goal,
            give_up_s=give_up_s,
            turn_limit_s=turn_limit_s,
        )
    extras.check("record", "`simulate`, whose results are read from a recording,")
    config, ending = check_plugins(config), Ending()
    with contextlib.ExitStack() as opened:
        if out is None:
            folder = Path(opened.enter_context(TemporaryDirectory(prefix="snakesim-")))
            write(config, folder / CONFIG)
            files = RunFiles(folder, print_stderr)
        else:
            files, _ = opened.enter_context(opened_files(config, out))
        if files.folder is None:
            raise ConfigError(f"{out} cannot be written to; choose another folder")
        opened.callback(files.close)
        recorded = SERVICE_STREAMS if out is None else [row.key for row in keys.SPACE]
        run, outcome, gave_up = _go(
            config,
            files,
            ending,
            None,
            recorded,
            until_goal=until_goal,
            give_up_s=give_up_s,
            raw_only=out is None,
            turn_limit_s=turn_limit_s,
        )
        explain(ending, record_of(run.host), config)
        record, summary = write_results(files, files.folder, ending, outcome, report=out is not None)
        # No local variable holds the failure: its traceback holds this function's frame.
        return Result(record, summary, gave_up, ControlFailure.of(run.take_errors().get(CONTROL)))


def run_in_process(
    config: RunConfig,
    out: Path | None,
    *,
    until_goal: bool = False,
    give_up_s: float | None = None,
    record: bool = True,
    raw_only: bool = False,
    pulse: Pulse | None = None,
) -> int:
    """`snakesim run --in-process`. Exit code: as of a run in processes. until_goal, give_up_s: as of `simulate`.

    raw_only: the recording is without topics for viewers. pulse: shows another process whether the run goes on.
    """
    check(config)
    check_recorder(record=record)
    ending = Ending()
    with opened_files(config, out) as (files, _):
        say(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander}, in one process")
        with interruptible(ending):
            with Progress(config) as progress:
                recorded = [row.key for row in keys.SPACE] if record else []
                _, outcome, _ = _go(
                    config,
                    files,
                    ending,
                    progress,
                    recorded,
                    until_goal=until_goal,
                    give_up_s=give_up_s,
                    raw_only=raw_only,
                    pulse=pulse,
                )
            return conclude(config, files, ending, outcome)


def _go(
    config: RunConfig,
    files: RunFiles,
    ending: Ending,
    progress: Progress | None,
    recorded: Iterable[str],
    *,
    until_goal: bool,
    give_up_s: float | None,
    raw_only: bool,
    pulse: Pulse | None = None,
    turn_limit_s: float | None = None,
) -> tuple[InProcessRun, Outcome, bool]:
    """recorded: keys, which may have wildcards. Also returns whether it was given up."""
    words = _LogWriter(files)
    run = InProcessRun(config, pulse, turn_limit_s)
    ending.on_interrupt = run.hurry
    with contextlib.redirect_stderr(words), run:
        host, session = run.host, run.network.session()
        if progress is not None:
            say(describe_what_moves(host.description))
        control = session.reader(keys.CONTROL_STATE, ControlState)
        watch = GoalWatch(config, host.description, give_up_s)
        with (
            HostRecordWriter(host.black_box, host.description, partial(record_of, host), files.folder),
            _recording(session, files, recorded, None if raw_only else config.robot.name) as recording,
        ):
            for turn, _ in enumerate(run.iterate_ticks()):
                if turn % TAKEN_EVERY == 0:
                    if recording is not None:
                        recording.flush_when_due()
                    if progress is not None and host.authority.arm_session:  # before that there is nothing to wait for
                        progress.show(host.status(), control.newest(lambda _state: True), armed=True)
                    if (until_goal or config.mission.until_goal) and watch.over(host.black_box):
                        host.complete()
                if ending.interrupted:
                    run.stop()
    ending.over = True
    for failure in run.failed:
        ending.add_cause(failure)
    lost = [] if recording is None or not recording.failure else [recording.failure]
    outcome = Outcome(record_of(run.host), run.host.description, lost=lost, too_slow=run.too_slow())
    return run, outcome, watch.gave_up


@contextlib.contextmanager
def _recording(
    session: Session, files: RunFiles, recorded: Iterable[str], shown_as: str | None
) -> "Iterator[Recording | None]":
    """Record what is published at these keys; None when there are none, or no file can be made."""
    recording = None
    try:
        if files.folder is not None and recorded:
            from snakesim_operator.recording.recording import Recording  # needs the extra `record`

            recording = Recording(files.folder / RECORDING, shown_as)
            for key in recorded:
                session.on_latched_arrival(key, recording.take)
    except OSError as error:
        files.warn(f"{files.folder}: {error.strerror}")
    try:
        yield recording
    finally:
        if recording is not None:
            recording.close({"version": version("snakesim"), "dropped": {}, "keys": list(recorded)})
            if recording.failure:
                files.warn(recording.failure)


class _LogWriter(io.TextIOBase):
    """Takes what is printed to stderr into the run's folder."""

    def __init__(self, files: RunFiles) -> None:
        self._files = files

    def write(self, text: str) -> int:
        """From any thread."""
        self._files.append(WORDS, text.encode(errors="replace"))
        return len(text)

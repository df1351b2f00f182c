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
from snakesim_hal.base.terminal import print_line, print_stderr
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.plugins import anything_offered
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.programs.host_program import create_host_record
from snakesim_hal.programs.preflight import check_plugins
from snakesim_hal.programs.single_process import InProcessRun, check
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.base import extras
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.results.metrics.advance import GoalWatch
from snakesim_operator.results.recording_contents import SERVICE_STREAMS
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.conclusion import Outcome, conclude, note_reasons, write_results
from snakesim_operator.run.ending import Ending, interruptible
from snakesim_operator.run.pinned_process import call_pinned
from snakesim_operator.run.progress import Progress
from snakesim_operator.run.run import check_recorder, opened_files
from snakesim_operator.run.run_files import RunFiles

if TYPE_CHECKING:
    from snakesim_operator.recording.writer import RecordingWriter

LOG_FILE = "run.log"  # gets what the parts of the run print to stderr
POLL_TICKS = 50  # between two looks at the progress, the goal and the recording


class ChildTracebackError(Exception):
    """Stands for an exception of a child process; its text is the traceback there."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


@dataclass(frozen=True)
class ControlFailure:
    """Why control could not continue."""

    message: str
    cause: BaseException | None  # what the controller raised; None: its answer was not allowed

    @staticmethod
    def from_error(error: SnakesimError | None) -> "ControlFailure | None":
        """Return the failure that belongs to the error that ended control; None without an error."""
        if error is None:
            return None
        if isinstance(error, ControllerError):
            return ControlFailure(str(error), error.__cause__)
        return ControlFailure(str(error), error)

    def __reduce__(self) -> Any:
        """Pickle the traceback as text: frames stay in their process."""
        if self.cause is None:
            return ControlFailure, (self.message, None)
        text = "".join(traceback.format_exception(self.cause))
        return ControlFailure, (self.message, ChildTracebackError(text))


@dataclass(frozen=True)
class Result:
    """A run that is over; `summary.ended` is how it ended."""

    record: RunRecord  # every tick, and what control and guidance reported
    summary: RunSummary
    gave_up: bool = False  # the run was ended because the robot was stuck
    control_failure: ControlFailure | None = None  # None: control went on to the end


def simulate(
    config: RunConfig,
    out: Path | None = None,
    *,
    until_goal: bool = False,
    give_up_s: float | None = None,
    turn_limit_s: float | None = None,
) -> Result:
    """Run a configuration in this process, and return what was recorded.

    A program that has imported NumPy already may have bound it to other processor code than `snakesim run` has; then
    the run is computed in a child process, so that its digest is the same. `snakesim.use_common_arithmetic()` before
    the first import of NumPy keeps it in this process. So does a plugin that the program offers itself: then the digest
    may be its computer's own (`summary.own_arithmetic`).

    Args:
        config: configuration of the run.
        out: folder for the files of the run, with the report; None keeps no files.
        until_goal: whether a run whose mission has a goal is complete soon after the goal is reached.
        give_up_s: robot time without 3 cm of advance towards the goal after which the run ends; None: never.
        turn_limit_s: wall time that a part of the run may take in one tick, 60 s by default, or `start_limit_s` if
            that is longer.

    Returns:
        The record and the summary, also for a run that ended early.

    Raises:
        SnakesimError: the run cannot begin.
    """
    if not isinstance(config, RunConfig):
        raise ConfigError(
            f"simulate() takes a RunConfig, not {config!r:.60}; `snakesim.run` takes a scenario's name or path",
            code="python/invalid-argument",
        )
    if not is_pinned() and not anything_offered():  # a child would not have the plugins that this program offers
        return call_pinned(
            simulate,
            config=config,
            out=out,
            until_goal=until_goal,
            give_up_s=give_up_s,
            turn_limit_s=turn_limit_s,
        )
    extras.require("record", "`simulate`, whose results are read from a recording,")
    config = check_plugins(config)
    ending = Ending()
    with contextlib.ExitStack() as opened:
        if out is None:
            folder = Path(opened.enter_context(TemporaryDirectory(prefix="snakesim-")))
            write_config(config, folder / CONFIG)
            files = RunFiles(folder, print_stderr)
        else:
            files, _ = opened.enter_context(opened_files(config, out))
        if files.folder is None:
            raise ConfigError(f"{out} cannot be written to; choose another folder", code="file/not-writable")
        opened.callback(files.close)
        recorded_keys = (*SERVICE_STREAMS, keys.CONTACTS) if out is None else _all_keys()
        run, outcome, gave_up = _run_to_end(
            config,
            files,
            ending,
            None,
            recorded_keys,
            until_goal=until_goal,
            give_up_s=give_up_s,
            raw_only=out is None,
            turn_limit_s=turn_limit_s,
        )
        note_reasons(ending, create_host_record(run.host), config)
        record, summary = write_results(files, files.folder, ending, outcome, report=out is not None)
        # No local variable holds the failure: its traceback holds this function's frame.
        return Result(record, summary, gave_up, ControlFailure.from_error(run.take_errors().get(CONTROL)))


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
    """Run a configuration for `snakesim run --in-process`, with progress and results on the terminal.

    Args:
        config: configuration of the run.
        out: folder for the files of the run; None for the default one.
        until_goal: as for `simulate`.
        give_up_s: as for `simulate`.
        record: whether to record all messages.
        raw_only: whether the recording is without topics for viewers.
        pulse: shows another process whether the run makes progress.

    Returns:
        The exit code, as of a run in processes.
    """
    check(config)
    check_recorder(record=record)
    ending = Ending()
    with opened_files(config, out) as (files, _):
        print_line(f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander}, in one process")
        with interruptible(ending):
            with Progress(config) as progress:
                _, outcome, _ = _run_to_end(
                    config,
                    files,
                    ending,
                    progress,
                    _all_keys() if record else [],
                    until_goal=until_goal,
                    give_up_s=give_up_s,
                    raw_only=raw_only,
                    pulse=pulse,
                )
            return conclude(config, files, ending, outcome)


def _all_keys() -> list[str]:
    return [row.key for row in keys.SPACE]


def _run_to_end(
    config: RunConfig,
    files: RunFiles,
    ending: Ending,
    progress: Progress | None,
    recorded_keys: Iterable[str],
    *,
    until_goal: bool,
    give_up_s: float | None,
    raw_only: bool,
    pulse: Pulse | None = None,
    turn_limit_s: float | None = None,
) -> tuple[InProcessRun, Outcome, bool]:
    """Run a configuration until it is over, with its record and its recording.

    Args:
        config: configuration of the run.
        files: writes into the run's folder.
        ending: collects the reasons for which the run ends, and is set when it is interrupted.
        progress: shows the run on the terminal; None shows nothing.
        recorded_keys: may have wildcards; empty for no recording.
        until_goal: as for `simulate`.
        give_up_s: as for `simulate`.
        raw_only: whether the recording is without topics for viewers.
        pulse: shows another process whether the run makes progress.
        turn_limit_s: as for `simulate`.

    Returns:
        The run, what is known of it, and whether it was ended because the robot was stuck.
    """
    run = InProcessRun(config, pulse, turn_limit_s)
    ending.on_interrupt = run.hurry
    with contextlib.redirect_stderr(_LogWriter(files)), run:
        host = run.host
        session = run.network.session()
        if progress is not None:
            print_line(describe_what_moves(host.description))
        control_states = session.reader(keys.CONTROL_STATE, ControlState)
        goal_watch = GoalWatch(config, host.description, give_up_s)
        ends_at_goal = until_goal or config.mission.until_goal
        with (
            HostRecordWriter(host.black_box, host.description, partial(create_host_record, host), files.folder),
            _recording(session, files, recorded_keys, None if raw_only else config.robot.name) as recording,
        ):
            for turn, _ in enumerate(run.iterate_ticks()):
                if turn % POLL_TICKS == 0:
                    if recording is not None:
                        recording.flush_when_due()
                    if progress is not None and host.authority.arm_session:  # before the arming nothing changes
                        progress.update(host.status(), control_states.newest(lambda _state: True), armed=True)
                    if ends_at_goal and goal_watch.over(host.black_box):
                        host.complete()
                if ending.interrupted:
                    run.stop()
    ending.over = True
    for failure in run.failed:
        ending.add_cause(failure)
    lost = [recording.failure] if recording is not None and recording.failure else []
    outcome = Outcome(create_host_record(run.host), run.host.description, lost=lost, too_slow=run.too_slow())
    return run, outcome, goal_watch.gave_up


@contextlib.contextmanager
def _recording(
    session: Session, files: RunFiles, recorded_keys: Iterable[str], shown_as: str | None
) -> "Iterator[RecordingWriter | None]":
    """Record the messages at these keys for as long as the context lives.

    Yields None when there are no keys, or when no file can be created.
    """
    recording = None
    try:
        if files.folder is not None and recorded_keys:
            from snakesim_operator.recording.writer import RecordingWriter  # needs the extra `record`

            recording = RecordingWriter(files.folder / RECORDING, shown_as)
            for key in recorded_keys:
                session.on_latched_arrival(key, recording.write_arrival)
    except OSError as error:
        files.warn(f"{files.folder}: {error.strerror}")
    try:
        yield recording
    finally:
        if recording is not None:
            recording.close({"version": version("snakesim"), "dropped": {}, "keys": list(recorded_keys)})
            if recording.failure:
                files.warn(recording.failure)


class _LogWriter(io.TextIOBase):
    """Writes the text that is printed to stderr into the run's folder."""

    def __init__(self, files: RunFiles) -> None:
        self._files = files

    def write(self, text: str) -> int:
        """Append a text to the log. May be called from any thread."""
        self._files.append(LOG_FILE, text.encode(errors="replace"))
        return len(text)

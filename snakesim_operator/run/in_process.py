"""Runs without processes or a network: `snakesim run --in-process`, and `simulate` for programs.

    from snakesim_hal.model.scenario import load_scenario, parse_set_option
    from snakesim_operator.run.in_process import simulate

    result = simulate(load_scenario("triplet", [parse_set_option("seed=3"), parse_set_option("duration_s=5")]).config)
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
from snakesim_hal.base.step_limit import SharedStepTimes
from snakesim_hal.base.terminal import print_line, print_stderr
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.plugins import has_registered_plugins
from snakesim_hal.model.scenario import RunConfig, write_config
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.programs.host_program import create_host_record
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_hal.programs.single_process import InProcessRun, validate_single_process_config
from snakesim_hal.run_log.writer import HostRecordWriter
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.base import extras
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.metrics.advance import GoalMonitor
from snakesim_operator.results.recording_contents import SERVICE_OUTPUT_KEYS
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import CONFIG_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.conclusion import (
    RunConclusion,
    add_end_causes,
    write_and_print_results,
    write_results,
)
from snakesim_operator.run.ending import RunEnding, end_run_on_signals
from snakesim_operator.run.processes.pinned_process import call_in_pinned_process
from snakesim_operator.run.progress import RunProgress
from snakesim_operator.run.run import open_run_files, require_recorder
from snakesim_operator.run.run_files import RunFiles

if TYPE_CHECKING:
    from snakesim_operator.recording.writer import RecordingWriter

LOG_FILE = "run.log"  # gets what the parts of the run print to stderr
TICKS_PER_POLL = 50  # between two looks at the progress, the goal and the recording


class ChildTracebackError(Exception):
    """Replaces an exception of a child process; its text is the traceback in the child."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


@dataclass(frozen=True)
class ControlFailure:
    """The reason why control could not continue."""

    message: str
    cause: BaseException | None  # exception of the controller; None if its command was invalid

    @staticmethod
    def from_error(error: SnakesimError | None) -> "ControlFailure | None":
        """Make the failure for the error that ended control; None without an error."""
        if error is None:
            return None
        if isinstance(error, ControllerError):
            return ControlFailure(str(error), error.__cause__)
        return ControlFailure(str(error), error)

    def __reduce__(self) -> Any:
        """Pickle the traceback as text, because its frames cannot be pickled."""
        if self.cause is None:
            return ControlFailure, (self.message, None)
        text = "".join(traceback.format_exception(self.cause))
        return ControlFailure, (self.message, ChildTracebackError(text))


@dataclass(frozen=True)
class InProcessResult:
    """Results of a run that is over; `summary.ended` is how it ended."""

    record: RunRecord  # every tick, and what control and guidance reported
    summary: RunSummary
    has_stalled: bool = False  # the run was ended because the robot was stuck
    control_failure: ControlFailure | None = None  # None if control continued until the end


def simulate(
    config: RunConfig,
    out: Path | None = None,
    *,
    until_goal: bool = False,
    stall_timeout_s: float | None = None,
    turn_limit_s: float | None = None,
) -> InProcessResult:
    """Run a configuration in this process, and return what was recorded.

    A program that has imported NumPy already may have bound it to other processor code than `snakesim run` has; then
    the run is computed in a child process, so that its digest is the same. `snakesim.use_common_arithmetic()` before
    the first import of NumPy keeps it in this process. So does a plugin that the program offers itself: then the digest
    may be its computer's own (`summary.own_arithmetic`).

    Args:
        config: Configuration of the run.
        out: Path of the folder for the files of the run, with the report; None to keep no files.
        until_goal: Whether the run is complete soon after the goal of its mission is reached.
        stall_timeout_s: Robot time without 3 cm of advance to the goal that ends the run, in s; None for no timeout.
        turn_limit_s: Wall time that a part of the run may take in one tick, 60 s by default, or `start_limit_s` if
            that is longer.

    Returns:
        The record and the summary, also for a run that ended early.

    Raises:
        SnakesimError: The run cannot start.
    """
    if not isinstance(config, RunConfig):
        raise ConfigError(
            f"simulate() takes a RunConfig, not {config!r:.60}; `snakesim.run` takes a scenario's name or path",
            code="python/invalid-argument",
        )
    # A child would not have the plugins that this program offers.
    if not is_pinned() and not has_registered_plugins():
        return call_in_pinned_process(
            simulate,
            config=config,
            out=out,
            until_goal=until_goal,
            stall_timeout_s=stall_timeout_s,
            turn_limit_s=turn_limit_s,
        )
    extras.require_extra("record", "`simulate`, whose results are read from a recording,")
    config = validate_and_complete_config(config)
    ending = RunEnding()
    with contextlib.ExitStack() as exit_stack:
        if out is None:
            folder = Path(exit_stack.enter_context(TemporaryDirectory(prefix="snakesim-")))
            write_config(config, folder / CONFIG_FILENAME)
            files = RunFiles(folder, print_stderr)
        else:
            files, _ = exit_stack.enter_context(open_run_files(config, out))
        if files.folder is None:
            raise ConfigError(
                f"{out} cannot be written to; choose another folder", code="file/not-writable"
            )
        exit_stack.callback(files.close)
        recorded_keys = (*SERVICE_OUTPUT_KEYS, keys.CONTACTS) if out is None else _list_all_keys()
        run, outcome, has_stalled = _run_until_over(
            config,
            files,
            ending,
            None,
            recorded_keys,
            until_goal=until_goal,
            stall_timeout_s=stall_timeout_s,
            raw_only=out is None,
            turn_limit_s=turn_limit_s,
        )
        add_end_causes(ending, create_host_record(run.host), config)
        record, summary = write_results(
            files, files.folder, ending, outcome, report=out is not None
        )
        # No local variable holds the failure: its traceback holds this function's frame.
        return InProcessResult(
            record, summary, has_stalled, ControlFailure.from_error(run.pop_errors().get(CONTROL))
        )


def run_in_process(
    config: RunConfig,
    out: Path | None,
    *,
    until_goal: bool = False,
    stall_timeout_s: float | None = None,
    record: bool = True,
    raw_only: bool = False,
    step_times: SharedStepTimes | None = None,
) -> int:
    """Run a configuration for `snakesim run --in-process`, with progress and results on the terminal.

    Args:
        config: Configuration of the run.
        out: Path of the folder for the files of the run; None for the default folder.
        until_goal: Whether the run is complete soon after the goal of its mission is reached.
        stall_timeout_s: Robot time without 3 cm of advance to the goal that ends the run, in s; None for no timeout.
        record: Whether to record all messages.
        raw_only: Whether the recording contains no topics for viewers.
        step_times: Shared memory that shows another process whether the run makes progress; None for none.

    Returns:
        The exit code, as of `snakesim run` without `--in-process`.
    """
    validate_single_process_config(config)
    require_recorder(record=record)
    ending = RunEnding()
    with open_run_files(config, out) as (files, _):
        print_line(
            f"{config.name}: {config.robot.name} in {config.scene.name}, {config.commander_name}, in one process"
        )
        with end_run_on_signals(ending):
            with RunProgress(config) as progress:
                _, outcome, _ = _run_until_over(
                    config,
                    files,
                    ending,
                    progress,
                    _list_all_keys() if record else [],
                    until_goal=until_goal,
                    stall_timeout_s=stall_timeout_s,
                    raw_only=raw_only,
                    step_times=step_times,
                )
            return write_and_print_results(config, files, ending, outcome)


def _list_all_keys() -> list[str]:
    """List the keys of all messages of SnakeSIM."""
    return [row.key for row in keys.SPACE]


def _run_until_over(
    config: RunConfig,
    files: RunFiles,
    ending: RunEnding,
    progress: RunProgress | None,
    recorded_keys: Iterable[str],
    *,
    until_goal: bool,
    stall_timeout_s: float | None,
    raw_only: bool,
    step_times: SharedStepTimes | None = None,
    turn_limit_s: float | None = None,
) -> tuple[InProcessRun, RunConclusion, bool]:
    """Run a configuration until it is over, and write its record and its recording.

    Args:
        config: Configuration of the run.
        files: Writer of the files of the run.
        ending: Collects the causes of the end, and shows whether the run is interrupted.
        progress: Progress line on the terminal; None to show nothing.
        recorded_keys: Keys of the recorded messages, which may have wildcards; empty for no recording.
        until_goal: Whether the run is complete soon after the goal of its mission is reached.
        stall_timeout_s: Robot time without 3 cm of advance to the goal that ends the run, in s; None for no timeout.
        raw_only: Whether the recording contains no topics for viewers.
        step_times: Shared memory that shows another process whether the run makes progress; None for none.
        turn_limit_s: Wall time that a part of the run may take in one tick, in s; None for the default.

    Returns:
        The run, its outcome, and whether it was ended because the robot was stuck.
    """
    run = InProcessRun(config, step_times, turn_limit_s)
    ending.on_interrupt = run.interrupt_after_grace_period
    with contextlib.redirect_stderr(_LogWriter(files)), run:
        host = run.host
        session = run.network.create_session()
        if progress is not None:
            print_line(describe_what_moves(host.description))
        control_states = session.declare_reader(keys.CONTROL_STATE, ControlState)
        goal_monitor = GoalMonitor(config, host.description, stall_timeout_s)
        ends_at_goal = until_goal or config.mission.until_goal
        with (
            HostRecordWriter(
                host.black_box, host.description, partial(create_host_record, host), files.folder
            ),
            _record_messages(
                session, files, recorded_keys, None if raw_only else config.robot.name
            ) as recording,
        ):
            for tick_count, _ in enumerate(run.iterate_ticks()):
                if tick_count % TICKS_PER_POLL == 0:
                    if recording is not None:
                        recording.flush_when_due()
                    # Before the arming nothing changes.
                    if progress is not None and host.authority.arm_session:
                        progress.update(
                            host.build_status(),
                            control_states.pop_newest(lambda _state: True),
                            armed=True,
                        )
                    if ends_at_goal and goal_monitor.update_and_check_end(host.black_box):
                        host.request_completion()
                if ending.is_interrupted:
                    run.stop()
    ending.is_over = True
    for failure in run.failed_services:
        ending.add_cause(failure)
    losses = [recording.failure] if recording is not None and recording.failure else []
    outcome = RunConclusion(
        create_host_record(run.host),
        run.host.description,
        recording_losses=losses,
        slow_services=run.list_slow_services(),
    )
    return run, outcome, goal_monitor.has_stalled


@contextlib.contextmanager
def _record_messages(
    session: Session, files: RunFiles, recorded_keys: Iterable[str], viewer_name: str | None
) -> "Iterator[RecordingWriter | None]":
    """Record the messages at some keys while the context is active.

    Args:
        session: Session on the network of the run.
        files: Files of the run; without a folder, nothing is recorded.
        recorded_keys: Keys of the messages, which may have wildcards; empty to record nothing.
        viewer_name: Name of the robot in topics for viewers; None to record no such topics.

    Yields:
        The writer of the recording; None if there are no keys, or if the file cannot be created.
    """
    recording = None
    try:
        if files.folder is not None and recorded_keys:
            # Needs the extra `record`.
            from snakesim_operator.recording.writer import RecordingWriter

            recording = RecordingWriter(files.folder / RECORDING_FILENAME, viewer_name)
            for key in recorded_keys:
                session.on_latched_arrival(key, recording.write_arrival)
    except OSError as error:
        files.warn(f"{files.folder}: {error.strerror}")
    try:
        yield recording
    finally:
        if recording is not None:
            recording.close(
                {"version": version("snakesim"), "dropped": {}, "keys": list(recorded_keys)}
            )
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

"""Concludes a run: writes the summary and the report, and prints a few lines on the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.arithmetic import format_digest
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.host.latch import ESTOP
from snakesim_hal.model.plugins import make_pip_install_command
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import EMULATED, REAL, UNKNOWN
from snakesim_hal.network.local_registry import get_robot_state_folder
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.base import extras
from snakesim_operator.results import last_run
from snakesim_operator.results.missing_data import EXIT_INCOMPLETE, describe_unwritten_data
from snakesim_operator.results.run_ending import COMPLETE, describe_early_end
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT_FILENAME, SUMMARY_FILENAME
from snakesim_operator.results.summary import (
    ProcessRestart,
    RunSummary,
    get_distance_m,
    get_estimates,
    summarize_run,
)
from snakesim_operator.run.ending import RunEnding
from snakesim_operator.run.run_files import RunFiles

MAX_JOINTS_SHOWN = 8
# Of the energy per meter: a larger difference shows that the body traveled sideways.
MAX_ENERGY_DEVIATION = 0.2
EXIT_COMPLETE, EXIT_FAILED, EXIT_INTERRUPTED = 0, 1, 130


@dataclass(frozen=True)
class RunConclusion:
    """Results of a run that are not in its folder."""

    host_record: HostRecord | None  # statistics of the host; None if they are unknown
    description: RobotDescription | None
    restarts: Sequence[ProcessRestart] = ()
    host_count: int = 1
    recording_losses: Sequence[str] = ()  # reasons why the recording is incomplete
    # Services that could not keep up in real time; only known for a run in one process.
    slow_services: Sequence[str] = ()


def write_and_print_results(
    config: RunConfig,
    files: RunFiles,
    ending: RunEnding,
    outcome: RunConclusion,
    *,
    stay: bool = False,
) -> int:
    """Write the results of a run, print them, and close its files.

    Args:
        config: Configuration of the run.
        files: Files of the run; closed by this function.
        ending: Causes of the end that are known so far; further causes are added.
        outcome: Results that the host and the processes reported.
        stay: Whether faults that a person could reset are part of the run and do not end it.

    Returns:
        The exit code: 1 on a fault or an early end, 3 if the record has gaps, 130 if interrupted, otherwise 0.
    """
    host = outcome.host_record
    missing: list[str] = []
    verdict = ""
    if host is not None:
        add_end_causes(ending, host, config, stay=stay)
        missing, verdict = _write_and_print_summary(files, ending, outcome, host)
    loss_of_files = files.close()
    for loss in (*outcome.recording_losses, loss_of_files):
        if loss and loss not in missing:
            missing.append(loss)
    _print_run_end(files, ending, outcome, missing, verdict)
    last_run.save_last_run(str(files.folder or "no folder"), _describe_ending(ending))
    return _choose_exit_code(ending, host, missing)


def _choose_exit_code(ending: RunEnding, host: HostRecord | None, missing: Sequence[str]) -> int:
    if ending.is_interrupted:
        return EXIT_INTERRUPTED
    if host is None or ending.reason is not None:
        return EXIT_FAILED
    return EXIT_INCOMPLETE if missing else EXIT_COMPLETE


def add_end_causes(
    ending: RunEnding, host: HostRecord, config: RunConfig, *, stay: bool = False
) -> None:
    """Add the causes for which a run is not complete. A run is complete if it was armed for all of its time.

    Args:
        ending: Receives the causes.
        host: Statistics of the host.
        config: Configuration of the run.
        stay: Whether faults that a person could reset are part of the run and do not end it.
    """
    if not stay:
        for fault in host.faults:
            if fault.scope == "robot":
                ending.add_cause(fault.cause)
    early_end = describe_early_end(host, config)
    if early_end and (host.ended == "running" or ending.reason is None):
        ending.add_cause(early_end)


def _describe_ending(ending: RunEnding) -> str:
    if ending.is_interrupted:
        return "interrupted"
    return ending.reason or COMPLETE


def _write_and_print_summary(
    files: RunFiles, ending: RunEnding, outcome: RunConclusion, host: HostRecord
) -> tuple[list[str], str]:
    """Write summary and report of a run, and print the summary.

    Args:
        files: Files of the run; without a folder, nothing is written.
        ending: How and why the run ended.
        outcome: Results that the host and the processes reported.
        host: Statistics of the host at its end.

    Returns:
        Sentences about missing data, and the text of the verdict. The text is empty if no report was written.
    """
    if files.folder is None:
        _print_host(host)
        return ["nothing was recorded"], ""
    try:
        record, summary = write_results(files, files.folder, ending, outcome)
        print_summary(summary)
    except ConfigError as error:
        _print_host(host)
        return [*describe_unwritten_data(host), str(error)], ""
    missing = [*describe_unwritten_data(record.host), *record.recorder_losses]
    if not extras.is_installed("record"):
        return missing, ""
    from snakesim_operator.results.report.verdict import make_verdict

    return missing, make_verdict(record, summary).text


def write_results(
    files: RunFiles, folder: Path, ending: RunEnding, outcome: RunConclusion, *, report: bool = True
) -> tuple[RunRecord, RunSummary]:
    """Load the record of a run from disk, and write its summary and report.

    Args:
        files: Writer of the files in the folder.
        folder: Folder of the run, from which the record is read.
        ending: How and why the run ended.
        outcome: Results that the host and the processes reported.
        report: Whether to write the report, too, if its extra is installed.

    Returns:
        The record, and its summary.

    Raises:
        ConfigError: The folder contains no valid record.
    """
    files.wait_until_written()
    record = RunRecord.load(folder, outcome.host_record)
    summary = summarize_run(record, _describe_ending(ending), outcome.restarts, outcome.host_count)
    if outcome.slow_services:
        summary = msgspec.structs.replace(summary, too_slow=list(outcome.slow_services))
    files.write_file(SUMMARY_FILENAME, msgspec.json.format(msgspec.json.encode(summary), indent=2))
    if report and extras.is_installed("record"):
        # Templates take a while to import, and the start of a run does not wait for them.
        from snakesim_operator.results.report import render_report

        files.write_file(REPORT_FILENAME, render_report(record, summary).encode())
    return record, summary


def _print_run_end(
    files: RunFiles, ending: RunEnding, outcome: RunConclusion, missing: Sequence[str], verdict: str
) -> None:
    if files.folder is not None:
        _print_paths(files.folder)
    if verdict:
        print_line(verdict)
    if outcome.host_record is None:
        reason = ending.reason or "the host ended early"
        logs = (
            f"; the logs of its processes are in {files.folder}" if files.folder is not None else ""
        )
        print_line(f"the run left no record: {reason}{logs}")
    elif ending.reason is not None and not ending.is_interrupted:
        print_line(f"fault: {ending.reason}")
    if missing:
        print_line(f"record: incomplete: {'; '.join(missing)}")
    if outcome.description is not None:
        _print_stored_emergency_stop(outcome.description)


def _print_paths(folder: Path) -> None:
    """Print the paths of the summary and the report, if they were written."""
    for title, name in (("summary", SUMMARY_FILENAME), ("report", REPORT_FILENAME)):
        path = folder / name
        if path.is_file():
            print_line(f"{title + ':':<9}{path}")
    if (folder / SUMMARY_FILENAME).is_file() and not extras.is_installed("record"):
        print_line(
            f"report:  not written; {make_pip_install_command('record')}, then `snakesim recording report {folder}`"
        )


def _print_stored_emergency_stop(robot: RobotDescription) -> None:
    """Print how to reset a stored emergency stop of the robot, if there is one."""
    stop = get_robot_state_folder(robot.robot, robot.backend, robot.hardware) / ESTOP
    if stop.is_file():
        print_line(
            f"{robot.robot} is still stopped, and begins so in every run: `snakesim robot reset` ends that"
        )


def _print_host(host: HostRecord) -> None:
    """Print the statistics of the host, if there is no record on disk."""
    _print_row("ticks", f"{host.ticks}, of which {host.armed_ticks} armed, in {host.wall_s:.2f} s")
    _print_row("command digest", host.command_digest[:16])
    for fault in host.faults:
        _print_row("fault", fault.cause)


def _print_row(name: str, value: str) -> None:
    print_line(f"  {name:<22}{value}")


def print_summary(summary: RunSummary) -> None:
    """Print the main metrics of a run, one per line."""
    for name, value in (
        *_make_motion_rows(summary),
        *_make_state_rows(summary),
        *_make_failure_rows(summary),
    ):
        _print_row(name, value)
    for missing in summary.missing:
        _print_row("not known", missing)


def _make_motion_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Make the rows about the motion: distance, time, propulsion, torque, energy and forces."""
    distance_text = _format_number(get_distance_m(summary), "m", 3)
    speed_text = _format_number(summary.real_time_factor, "x", 1)
    rows = [
        _describe_hardware(summary),
        ("moved" if summary.path_distance_m is None else "moved along the path", distance_text),
        ("time", f"{summary.duration_s:.2f} s in {summary.wall_s:.2f} s ({speed_text})"),
    ]
    if summary.goal_reached_s:
        rows.append(("goal", f"{summary.goal_m:g} m, reached after {summary.goal_reached_s:.1f} s"))
    rows += [
        ("locomoting", _format_time_fraction(summary.locomoting_fraction)),
        ("propulsion joints", _describe_propulsion(summary)),
        ("peak joint torque", _format_number(summary.peak_joint_torque_nm, "N·m")),
        ("energy per meter", _describe_energy(summary)),
        ("contact over 50 ms", _format_number(summary.peak_contact_force_n, "N", 1)),
    ]
    force_tracking = _describe_force_tracking(summary)
    if force_tracking:
        rows.append(("desired forces", force_tracking))
    return rows


def _make_state_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Make the rows about the last state, the command digest, slow services and estimates."""
    last_state = f"{summary.last_state}: {summary.last_reason}" if summary.last_state else "unknown"
    rows = [("last state", last_state)]
    measured = (summary.last_state, summary.last_reason)
    reported = (summary.reported_state, summary.reported_reason)
    if summary.reported_state is not None and reported != measured:
        rows.append(("control reported", f"{summary.reported_state}: {summary.reported_reason}"))
    rows.append(("command digest", format_digest(summary.command_digest, summary.own_arithmetic)))
    rows += [("too slow", service) for service in summary.too_slow]
    rows += [("estimated", text) for text in get_estimates(summary).describe()]
    return rows


def _make_failure_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Make the rows about faults, isolated joints, restarts and jams; empty for a run without any."""
    rows: list[tuple[str, str]] = []
    if summary.faults:
        count = len(summary.faults) + summary.faults_left_out
        rows.append(("faults", f"{count}, the first: {summary.faults[0].cause}"))
    if summary.isolated:
        rows.append(("isolated", f"{', '.join(summary.isolated)}: failed, and passive since"))
    if summary.restarts:
        rows.append(("restarts", ", ".join(restart.name for restart in summary.restarts)))
    if summary.hosts > 1:
        rows.append(("host", f"the last of {summary.hosts}; everything above is of this one"))
    if summary.jammed:
        rows.append(("JAMMED", "the controller reported a jam; see the report"))
    return rows


def _format_number(value: float | None, unit: str, digits: int = 2) -> str:
    return "unknown" if value is None else f"{value:.{digits}f} {unit}"


def _format_time_fraction(fraction: float | None) -> str:
    return "unknown" if fraction is None else f"{100 * fraction:.0f} % of the time"


def _describe_force_tracking(summary: RunSummary) -> str:
    """Describe how well measured forces follow the desired forces; empty if there was nothing to compare."""
    error = summary.desired_force_error
    without_contact = summary.empty_push_points
    correlation = summary.desired_force_correlation
    if error is None or without_contact is None:
        return ""
    follows = "of unknown correlation" if correlation is None else f"correlation {correlation:.2f}"
    share = f"{100 * without_contact:.0f} % of push-points without contact"
    return f"measured: {follows}, median error {100 * error:.0f} %, {share}"


def _describe_energy(summary: RunSummary) -> str:
    """Describe the energy per meter towards the goal.

    Without a goal, the energy per meter along the first heading is described, and that along the displacement if the
    displacement has another direction.
    """
    along_j_per_m = summary.energy_j_per_m
    displaced_j_per_m = summary.displacement_energy_j_per_m
    along = "unknown" if along_j_per_m is None else f"{along_j_per_m:.1f} J/m"
    if summary.goal_m is not None or displaced_j_per_m is None:
        return along
    if along_j_per_m is None:
        return f"{displaced_j_per_m:.1f} J/m along its displacement, too little advance along the first heading"
    if abs(displaced_j_per_m - along_j_per_m) <= MAX_ENERGY_DEVIATION * along_j_per_m:
        return along
    return f"{displaced_j_per_m:.1f} J/m along its displacement, {along} along the first heading"


def _describe_hardware(summary: RunSummary) -> tuple[str, str]:
    """Make the row about whether real motors moved: its title and its text."""
    match summary.emulated:
        case True:
            return EMULATED, f"nothing real moved (backend {summary.backend})"
        case False:
            return REAL, f"motors moved (backend {summary.backend})"
        case None:
            return UNKNOWN, f"whether motors moved (backend {summary.backend})"


def _describe_propulsion(summary: RunSummary) -> str:
    """Describe the propulsion joints in the order in which they took over."""
    joints = summary.propulsion_joints
    if joints is None:
        return "unknown"
    if len(joints) <= MAX_JOINTS_SHOWN:
        return " -> ".join(joints) or "no joint alone"
    first_joints = " -> ".join(joints[:MAX_JOINTS_SHOWN])
    return f"{first_joints} -> ... ({summary.hand_overs} hand-overs in all)"

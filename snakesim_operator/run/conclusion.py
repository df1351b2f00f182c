"""Concludes a run: writes the summary and the report, and prints a few lines on the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.arithmetic import format_digest
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.host.latch import ESTOP
from snakesim_hal.model.plugins import pip_install
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import EMULATED, REAL, UNKNOWN
from snakesim_hal.network.local_registry import robot_folder
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_hal.wire.messages import Description
from snakesim_operator.base import extras
from snakesim_operator.results import last_run
from snakesim_operator.results.missing_data import INCOMPLETE, describe_unwritten
from snakesim_operator.results.run_ending import COMPLETE, describe_early_end
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.run_reader import REPORT, SUMMARY
from snakesim_operator.results.summary import Restart, RunSummary, distance_m, estimates_of, summarise
from snakesim_operator.run.ending import Ending
from snakesim_operator.run.run_files import RunFiles

JOINTS_SHOWN = 8
MAX_ENERGY_DEVIATION = 0.2  # of the energy per meter: a larger difference shows that the body traveled sideways
DONE, FAILED, INTERRUPTED = 0, 1, 130


@dataclass(frozen=True)
class Outcome:
    """What is known of a run beside its folder."""

    host: HostRecord | None  # the host's own statistics, as far as they are known
    robot: Description | None
    restarts: Sequence[Restart] = ()
    hosts: int = 1
    lost: Sequence[str] = ()  # reasons for which the recording is incomplete
    too_slow: Sequence[str] = ()  # services that could not keep up in real time; known of a run in one process


def conclude(config: RunConfig, files: RunFiles, ending: Ending, outcome: Outcome, *, stay: bool = False) -> int:
    """Write the results of a run and print them.

    Args:
        config: configuration of the run.
        files: the run's folder; closed by this function.
        ending: the reasons for the end that are known so far.
        outcome: what the host and the processes reported.
        stay: whether faults that a person could reset are part of the run, not its end.

    Returns:
        The exit code: 0, or 1 on a fault or an early end, 3 when the record has gaps, 130 when interrupted.
    """
    host = outcome.host
    missing: list[str] = []
    verdict = ""
    if host is not None:
        note_reasons(ending, host, config, stay=stay)
        missing, verdict = _write_and_print(files, ending, outcome, host)
    lost_by_files = files.close()
    for loss in (*outcome.lost, lost_by_files):
        if loss and loss not in missing:
            missing.append(loss)
    _print_end(files, ending, outcome, missing, verdict)
    last_run.save_last_run(str(files.folder or "no folder"), _describe_ending(ending))
    return _exit_code(ending, host, missing)


def _exit_code(ending: Ending, host: HostRecord | None, missing: Sequence[str]) -> int:
    if ending.interrupted:
        return INTERRUPTED
    if host is None or ending.reason is not None:
        return FAILED
    return INCOMPLETE if missing else DONE


def note_reasons(ending: Ending, host: HostRecord, config: RunConfig, *, stay: bool = False) -> None:
    """Note why a run is not complete. It is complete only if it was armed for all of its time.

    Args:
        ending: gets the reasons.
        host: statistics of the host.
        config: configuration of the run.
        stay: whether faults that a person could reset are part of the run, not its end.
    """
    if not stay:
        for fault in host.faults:
            if fault.reach == "robot":
                ending.add_cause(fault.cause)
    early_end = describe_early_end(host, config)
    if early_end and (host.ended == "running" or ending.reason is None):
        ending.add_cause(early_end)


def _describe_ending(ending: Ending) -> str:
    if ending.interrupted:
        return "interrupted"
    return ending.reason or COMPLETE


def _write_and_print(files: RunFiles, ending: Ending, outcome: Outcome, host: HostRecord) -> tuple[list[str], str]:
    """Write summary and report of a run, and print the summary.

    Args:
        files: The files of the run; without a folder, nothing is written.
        ending: Why and how the run ended.
        outcome: What the processes reported.
        host: What the host reported at its end.

    Returns:
        What the record is missing, and the verdict of the report; the verdict is empty without one.
    """
    if files.folder is None:
        _print_host(host)
        return ["nothing was recorded"], ""
    try:
        record, summary = write_results(files, files.folder, ending, outcome)
        print_summary(summary)
    except ConfigError as error:
        _print_host(host)
        return [*describe_unwritten(host), str(error)], ""
    missing = [*describe_unwritten(record.host), *record.unreached]
    if not extras.is_installed("record"):
        return missing, ""
    from snakesim_operator.results.report.verdict import verdict

    return missing, verdict(record, summary).words


def write_results(
    files: RunFiles, folder: Path, ending: Ending, outcome: Outcome, *, report: bool = True
) -> tuple[RunRecord, RunSummary]:
    """Write summary and report from the record on disk.

    Args:
        files: writes into the run's folder.
        folder: the run's folder, from which the record is read.
        ending: how the run ended.
        outcome: what the host and the processes reported.
        report: whether to write the report too, if its extra is installed.

    Raises:
        ConfigError: the folder has no valid record.
    """
    files.settle()
    record = RunRecord.load(folder, outcome.host)
    summary = summarise(record, _describe_ending(ending), outcome.restarts, outcome.hosts)
    if outcome.too_slow:
        summary = msgspec.structs.replace(summary, too_slow=list(outcome.too_slow))
    files.write_file(SUMMARY, msgspec.json.format(msgspec.json.encode(summary), indent=2))
    if report and extras.is_installed("record"):
        # Templates take a while to import, and the start of a run does not wait for them.
        from snakesim_operator.results.report import page

        files.write_file(REPORT, page(record, summary).encode())
    return record, summary


def _print_end(files: RunFiles, ending: Ending, outcome: Outcome, missing: Sequence[str], verdict: str) -> None:
    if files.folder is not None:
        _print_paths(files.folder)
    if verdict:
        print_line(verdict)
    if outcome.host is None:
        reason = ending.reason or "the host ended early"
        logs = f"; the logs of its processes are in {files.folder}" if files.folder is not None else ""
        print_line(f"the run left no record: {reason}{logs}")
    elif ending.reason is not None and not ending.interrupted:
        print_line(f"fault: {ending.reason}")
    if missing:
        print_line(f"record: incomplete: {'; '.join(missing)}")
    if outcome.robot is not None:
        _print_kept_stop(outcome.robot)


def _print_paths(folder: Path) -> None:
    """Print where summary and report are, as far as they were written."""
    for title, name in (("summary", SUMMARY), ("report", REPORT)):
        path = folder / name
        if path.is_file():
            print_line(f"{title + ':':<9}{path}")
    if (folder / SUMMARY).is_file() and not extras.is_installed("record"):
        print_line(f"report:  not written; {pip_install('record')}, then `snakesim recording report {folder}`")


def _print_kept_stop(robot: Description) -> None:
    """Print how to reset an emergency stop, if one is stored."""
    stop = robot_folder(robot.robot, robot.backend, robot.hardware) / ESTOP
    if stop.is_file():
        print_line(f"{robot.robot} is still stopped, and begins so in every run: `snakesim robot reset` ends that")


def _print_host(host: HostRecord) -> None:
    """Print what is known without a record on disk."""
    _print_row("ticks", f"{host.ticks}, of which {host.armed_ticks} armed, in {host.wall_s:.2f} s")
    _print_row("command digest", host.command_digest[:16])
    for fault in host.faults:
        _print_row("fault", fault.cause)


def _print_row(name: str, value: str) -> None:
    print_line(f"  {name:<22}{value}")


def print_summary(summary: RunSummary) -> None:
    """Print the numbers of a run, one line each."""
    for name, value in (*_motion_rows(summary), *_state_rows(summary), *_failure_rows(summary)):
        _print_row(name, value)
    for missing in summary.missing:
        _print_row("not known", missing)


def _motion_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return how far, how fast and with which forces the robot moved."""
    distance = _format_number(distance_m(summary), "m", 3)
    speed = _format_number(summary.real_time_factor, "x", 1)
    rows = [
        _describe_hardware(summary),
        ("moved" if summary.path_distance_m is None else "moved along the path", distance),
        ("time", f"{summary.duration_s:.2f} s in {summary.wall_s:.2f} s ({speed})"),
    ]
    if summary.crossed_s:
        rows.append(("goal", f"{summary.goal_m:g} m, reached after {summary.crossed_s:.1f} s"))
    rows += [
        ("locomoting", _format_time_fraction(summary.locomoting_fraction)),
        ("propulsion joints", _describe_propulsion(summary)),
        ("peak joint torque", _format_number(summary.peak_joint_torque_nm, "N·m")),
        ("energy per meter", _describe_energy(summary)),
        ("contact over 50 ms", _format_number(summary.peak_contact_force_n, "N", 1)),
    ]
    force_tracking = _describe_force_tracking(summary)
    if force_tracking:
        rows.append(("solved forces", force_tracking))
    return rows


def _state_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the last state, the digest, and what control and navigation reported."""
    last_state = f"{summary.last_state}: {summary.last_reason}" if summary.last_state else "unknown"
    rows = [("last state", last_state)]
    measured = (summary.last_state, summary.last_reason)
    reported = (summary.reported_state, summary.reported_reason)
    if summary.reported_state is not None and reported != measured:
        rows.append(("control reported", f"{summary.reported_state}: {summary.reported_reason}"))
    rows.append(("command digest", format_digest(summary.command_digest, summary.own_arithmetic)))
    rows += [("too slow", service) for service in summary.too_slow]
    rows += [("estimated", text) for text in estimates_of(summary).in_words()]
    return rows


def _failure_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return faults, isolated joints, restarts and jams; empty for a run without any."""
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
    """Return how well measured forces follow the desired ones; empty when there was nothing to compare."""
    error = summary.desired_force_error
    without_contact = summary.empty_push_points
    correlation = summary.desired_force_correlation
    if error is None or without_contact is None:
        return ""
    follows = "of unknown correlation" if correlation is None else f"correlation {correlation:.2f}"
    return f"measured: {follows}, median error {100 * error:.0f} %, {100 * without_contact:.0f} % of push-points empty"


def _describe_energy(summary: RunSummary) -> str:
    """Return the energy per meter towards the goal.

    Without a goal it counts along the first heading, and along the displacement if that has another direction.
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
    """Return whether real motors moved, as the title and text of a row."""
    match summary.emulated:
        case True:
            return EMULATED, f"nothing real moved (backend {summary.backend})"
        case False:
            return REAL, f"motors moved (backend {summary.backend})"
        case None:
            return UNKNOWN, f"whether motors moved (backend {summary.backend})"


def _describe_propulsion(summary: RunSummary) -> str:
    """Return the propulsion joints in the order in which they took over."""
    joints = summary.propulsion_joints
    if joints is None:
        return "unknown"
    if len(joints) <= JOINTS_SHOWN:
        return " -> ".join(joints) or "no joint alone"
    first_joints = " -> ".join(joints[:JOINTS_SHOWN])
    return f"{first_joints} -> ... ({summary.hand_overs} hand-overs in all)"

"""The end of a run: the summary, the report, and a few lines on the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from snakesim_hal.base.arithmetic import digest_text
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import say
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
from snakesim_operator.results.record import REPORT, SUMMARY, RunRecord
from snakesim_operator.results.run_ending import COMPLETE, ended_early
from snakesim_operator.results.summary import Restart, RunSummary, distance_m, estimates_of, summarise
from snakesim_operator.run.ending import Ending
from snakesim_operator.run.run_files import RunFiles

JOINTS_SHOWN = 8
ANOTHER_WAY = 0.2  # of the energy per metre: a larger difference shows that the body travelled sideways
DONE, FAILED, INTERRUPTED = 0, 1, 130


@dataclass(frozen=True)
class Outcome:
    """What is known of a run beside its folder."""

    host: HostRecord | None  # the host's own numbers, as far as they are known
    robot: Description | None
    restarts: Sequence[Restart] = ()
    hosts: int = 1
    lost: Sequence[str] = ()  # why the recording lacks something
    too_slow: Sequence[str] = ()  # services that could not keep up in real time; known of a run in one process


def conclude(config: RunConfig, files: RunFiles, ending: Ending, outcome: Outcome, *, stay: bool = False) -> int:
    """Write and print it all. Returns 0, 1 on a fault or an early end, 3 when the record has gaps, or 130.

    stay: faults that a person could clear are part of the run, not its end.
    """
    host = outcome.host
    lacks: list[str] = []
    seen = ""
    if host is not None:
        explain(ending, host, config, stay=stay)
        lacks, seen = _leave(files, ending, outcome, host)
    lost = files.close()
    lacks += [lack for lack in (*outcome.lost, lost) if lack and lack not in lacks]
    _print_end(files, ending, outcome, lacks, seen)
    last_run.remember(str(files.folder or "no folder"), _ended(ending))
    if ending.interrupted:
        return INTERRUPTED
    if host is None or ending.reason is not None:
        return FAILED
    return INCOMPLETE if lacks else DONE


def explain(ending: Ending, host: HostRecord, config: RunConfig, *, stay: bool = False) -> None:
    """A run is complete if it was armed for all of its time, and only then; otherwise note how it ended."""
    for fault in () if stay else host.faults:
        if fault.reach == "robot":
            ending.because(fault.cause)
    why = ended_early(host, config)
    if why and (host.ended == "running" or ending.reason is None):
        ending.because(why)


def _ended(ending: Ending) -> str:
    return "interrupted" if ending.interrupted else ending.reason or COMPLETE


def _leave(files: RunFiles, ending: Ending, outcome: Outcome, host: HostRecord) -> tuple[list[str], str]:
    """Summary and report, in the folder and on the terminal. Returns what the record lacks, and what was seen."""
    if files.folder is None:
        _print_host(host)
        return ["nothing was recorded"], ""
    try:
        record, summary = leave(files, files.folder, ending, outcome)
        print_summary(summary)
    except ConfigError as error:
        _print_host(host)
        return [*describe_unwritten(host), str(error)], ""
    lacks = [*describe_unwritten(record.host), *record.unreached]
    if not extras.has("report"):
        return lacks, ""
    from snakesim_operator.results.report.verdict import verdict

    return lacks, verdict(record, summary).words


def leave(
    files: RunFiles, folder: Path, ending: Ending, outcome: Outcome, *, report: bool = True
) -> tuple[RunRecord, RunSummary]:
    """Summary and report, made of what is on disk. Raises ConfigError when that is no record."""
    files.settle()
    record = RunRecord.load(folder, outcome.host)
    summary = summarise(record, _ended(ending), outcome.restarts, outcome.hosts)
    if outcome.too_slow:
        summary = msgspec.structs.replace(summary, too_slow=list(outcome.too_slow))
    files.put(SUMMARY, msgspec.json.format(msgspec.json.encode(summary), indent=2))
    if report and extras.has("report"):
        from snakesim_operator.results.report import page  # templates take a while to import, which no start waits for

        files.put(REPORT, page(record, summary).encode())
    return record, summary


def _print_end(files: RunFiles, ending: Ending, outcome: Outcome, lacks: Sequence[str], seen: str) -> None:
    out, host, robot = files.folder, outcome.host, outcome.robot
    for what, name in (("summary", SUMMARY), ("report", REPORT)):
        if out is not None and (out / name).is_file():
            say(f"{what + ':':<9}{out / name}")
    if out is not None and (out / SUMMARY).is_file() and not extras.has("report"):
        say(f"report:  not written; {pip_install('report')}, then `snakesim report {out}`")
    if seen:
        say(seen)
    if host is None:
        said = f"; the logs of its processes are in {out}" if out is not None else ""
        say(f"the run left no record: {ending.reason or 'the host ended early'}{said}")
    elif ending.reason is not None and not ending.interrupted:
        say(f"fault: {ending.reason}")
    if lacks:
        say(f"record: incomplete: {'; '.join(lacks)}")
    if robot is not None and (robot_folder(robot.robot, robot.backend, robot.hardware) / ESTOP).is_file():
        say(f"{robot.robot} is still stopped, and begins so in every run: `snakesim clear` ends that")


def _print_host(host: HostRecord) -> None:
    """Print what is known without a record on disk."""
    say(f"  {'ticks':<22}{host.ticks}, of which {host.armed_ticks} armed, in {host.wall_s:.2f} s")
    say(f"  {'command digest':<22}{host.command_digest[:16]}")
    for fault in host.faults:
        say(f"  {'fault':<22}{fault.cause}")


def _force_tracking(summary: RunSummary) -> str:
    """How well measured forces follow the solved ones; empty when there was nothing to compare."""
    error, empty, follows = summary.desired_force_error, summary.empty_push_points, summary.desired_force_correlation
    if error is None or empty is None:
        return ""
    correlation = "of unknown correlation" if follows is None else f"correlation {follows:.2f}"
    return f"measured: {correlation}, median error {100 * error:.0f} %, {100 * empty:.0f} % of push-points empty"


def print_summary(summary: RunSummary) -> None:
    """Print the numbers of a run, one line each."""

    def number(value: float | None, unit: str, digits: int = 2) -> str:
        return "unknown" if value is None else f"{value:.{digits}f} {unit}"

    straight = summary.path_distance_m is None
    rows = [
        _what_moved(summary),
        ("moved" if straight else "moved along the path", number(distance_m(summary), "m", 3)),
        (
            "time",
            f"{summary.duration_s:.2f} s in {summary.wall_s:.2f} s ({number(summary.real_time_factor, 'x', 1)})",
        ),
        *([("goal", f"{summary.goal_m:g} m, reached after {summary.crossed_s:.1f} s")] if summary.crossed_s else []),
        ("locomoting", _share_of_time(summary.locomoting_fraction)),
        ("propulsion joints", _in_short(summary)),
        ("peak joint torque", number(summary.peak_joint_torque_nm, "N·m")),
        ("energy per metre", _energy_per_metre(summary)),
        ("contact over 50 ms", number(summary.peak_contact_force_n, "N", 1)),
        *([("solved forces", words)] if (words := _force_tracking(summary)) else []),
        ("last state", f"{summary.last_state}: {summary.last_reason}" if summary.last_state else "unknown"),
        *_last_report(summary),
        ("command digest", digest_text(summary.command_digest, summary.own_arithmetic)),
    ]
    rows += [("too slow", words) for words in summary.too_slow]
    rows += [("estimated", words) for words in estimates_of(summary).in_words()]
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
    rows += [("not known", lack) for lack in summary.lacks]
    for name, value in rows:
        say(f"  {name:<22}{value}")


def _share_of_time(share: float | None) -> str:
    return "unknown" if share is None else f"{100 * share:.0f} % of the time"


def _last_report(summary: RunSummary) -> list[tuple[str, str]]:
    """What control reported last, where that is not what was measured."""
    reported = summary.reported_state, summary.reported_reason
    if summary.reported_state is None or reported == (summary.last_state, summary.last_reason):
        return []
    return [("control reported", f"{summary.reported_state}: {summary.reported_reason}")]


def _energy_per_metre(summary: RunSummary) -> str:
    """Towards the goal; without one along the first heading, and along the displacement where that is another way."""
    along = summary.energy_j_per_m
    displaced = summary.displacement_energy_j_per_m
    shown = "unknown" if along is None else f"{along:.1f} J/m"
    if summary.goal_m is not None or displaced is None:
        return shown
    if along is not None and abs(displaced - along) <= ANOTHER_WAY * along:
        return shown
    heading = "too little advance along the first heading" if along is None else f"{shown} along the first heading"
    return f"{displaced:.1f} J/m along its displacement, {heading}"


def _what_moved(summary: RunSummary) -> tuple[str, str]:
    match summary.emulated:
        case True:
            return EMULATED, f"nothing real moved (backend {summary.backend})"
        case False:
            return REAL, f"motors moved (backend {summary.backend})"
        case None:
            return UNKNOWN, f"whether motors moved (backend {summary.backend})"


def _in_short(summary: RunSummary) -> str:
    joints = summary.propulsion_joints
    if joints is None:
        return "unknown"
    if len(joints) <= JOINTS_SHOWN:
        return " -> ".join(joints) or "no joint alone"
    return f"{' -> '.join(joints[:JOINTS_SHOWN])} -> ... ({summary.hand_overs} hand-overs in all)"

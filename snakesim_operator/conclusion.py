"""What is left of a run when it is over: the summary, the report, and a few lines on the terminal."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from snakesim_hal.latch import ESTOP
from snakesim_operator import lastrun
from snakesim_operator.ending import Ending
from snakesim_operator.record import REPORT, SUMMARY, RunRecord
from snakesim_operator.report import write_report
from snakesim_operator.summary import RunSummary, summarise
from snakesim_operator.supervisor import Restart

JOINTS_SHOWN = 8


def conclude(out: Path, ending: Ending, restarts: Sequence[Restart], hosts: int, *, stay: bool) -> int:
    """Write it all. Returns 0, 1 on a fault, 130 when interrupted.

    stay: faults that a person could clear are part of the run, not its end.
    """
    record = RunRecord.load(out)
    for fault in () if stay else record.host.faults:
        if fault.reach == "robot":
            ending.because(fault.cause)
    ended = "interrupted" if ending.interrupted else ending.reason or "complete"
    summary = summarise(record, ended, restarts, hosts)
    (out / SUMMARY).write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2))
    write_report(record, summary)
    _print_summary(summary)
    print(f"summary: {out / SUMMARY}\nreport:  {out / REPORT}")
    failed = ended not in ("complete", "interrupted")
    lastrun.remember(out, ended)
    if failed:
        print(f"fault: {ended}")
    if (out / ESTOP).is_file():
        print(f"estop: still latched; a run in this folder begins stopped. Use --stay and clear it: {out / ESTOP}")
    return 130 if ending.interrupted else 1 if failed else 0


def _print_summary(summary: RunSummary) -> None:
    def number(value: float | None, unit: str, digits: int = 2) -> str:
        return "unknown" if value is None else f"{value:.{digits}f} {unit}"

    rows = [
        ("moved along the path", number(summary.path_distance_m, "m", 3)),
        (
            "time",
            f"{summary.duration_s:.2f} s in {summary.wall_s:.2f} s ({number(summary.real_time_factor, 'x', 1)})",
        ),
        (
            "locomoting",
            "unknown" if summary.locomoting_fraction is None else f"{100 * summary.locomoting_fraction:.0f} %",
        ),
        ("propulsion joints", _in_short(summary.propulsion_joints)),
        ("peak joint torque", number(summary.peak_joint_torque_nm, "N·m")),
        ("peak contact force", number(summary.peak_contact_force_n, "N", 1)),
        ("last state", f"{summary.last_state or 'unknown'}: {summary.last_reason or ''}"),
        ("command digest", summary.command_digest[:16]),
    ]
    if summary.faults:
        rows.append(("faults", f"{len(summary.faults)}, the first: {summary.faults[0].cause}"))
    if summary.isolated:
        rows.append(("isolated", f"{', '.join(summary.isolated)}: failed, and passive since"))
    if summary.restarts:
        rows.append(("restarts", ", ".join(restart.name for restart in summary.restarts)))
    if summary.hosts > 1:
        rows.append(("host", f"the last of {summary.hosts}; everything above is of this one"))
    if summary.jammed:
        rows.append(("JAMMED", "the controller reported a jam; see the report"))
    for name, value in rows:
        print(f"  {name:<22}{value}")


def _in_short(joints: Sequence[str]) -> str:
    if len(joints) <= JOINTS_SHOWN:
        return " -> ".join(joints) or "none"
    return f"{' -> '.join(joints[:JOINTS_SHOWN])} -> ... ({len(joints)} hand-overs in all)"

"""Judges a run that an unauthorized client has fuzzed: compares the period alone with the period under fuzzing."""

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from snakesim_hal.wire.messages import JointMode
from verification.fuzz.fuzz_client import ClientReport
from verification.fuzz.run_watcher import ObservedPeriod
from verification.fuzz.vitals import find_error_lines

# After arming. Until then the host holds the angles, and afterwards the controller does.
MAX_SETTLING_TICKS = 20
# Above the growth of the quiet period. Allocators keep 25 to 45 MB of payloads of 4 MiB, after 120,000 payloads too.
MAX_GROWTH_MB = 64.0
MAX_OVERRUN_FRACTION = 0.01  # of the ticks, above the quiet period
MAX_LOST_COMMAND_FRACTION = 0.01  # of the ticks, fewer accepted commands than in the quiet period


@dataclass
class NetworkVerdict:
    """Everything that was observed, and what of it must not be."""

    quiet: ObservedPeriod
    fuzzed: ObservedPeriod
    client_report: ClientReport
    host_record: HostRecord
    violations: list[str]


def judge_run(
    out: Path,
    quiet: ObservedPeriod,
    fuzzed: ObservedPeriod,
    client_report: ClientReport,
    payload_count: int,
) -> NetworkVerdict:
    """Judge a run that has ended.

    Args:
        out: The folder of the run.
        quiet: The period without payloads.
        fuzzed: The period with payloads; the quiet period if there was no other.
        client_report: What the client sent.
        payload_count: The number of payloads that it had to send.
    """
    host_record = msgspec.json.decode((out / HOST_RECORD).read_bytes(), type=HostRecord)
    violations = [f"in a log: {line}" for line in find_error_lines(out)]
    violations += _find_foreign_setpoints(out, host_record)
    if quiet.failures:
        violations += [
            f"before the first payload, {failure}: is this machine too busy?"
            for failure in quiet.failures
        ]
    else:
        violations += fuzzed.failures
        violations += _find_status_changes(quiet, fuzzed)
        violations += _find_lost_payloads(client_report, payload_count)
        violations += _find_excesses(quiet, fuzzed)
    return NetworkVerdict(quiet, fuzzed, client_report, host_record, violations)


def _find_foreign_setpoints(out: Path, record: HostRecord) -> list[str]:
    """Find faults, and setpoints that the holding controller did not request."""
    violations = [f"fault {fault.what}: {fault.cause}" for fault in record.faults]
    _, black_box = read_black_box(out / BLACK_BOX)
    ticks_in_other_mode = (black_box["mode"] != JointMode.POSITION).any(axis=1)
    if ticks_in_other_mode.any():
        count = int(ticks_in_other_mode.sum())
        violations.append(f"{count} ticks in another mode than position")
        return violations
    targets_rad = black_box["target"]
    if not len(targets_rad):
        return violations
    deviations_rad = np.abs(targets_rad - targets_rad[-1])
    foreign_ticks = np.flatnonzero((targets_rad != targets_rad[-1]).any(axis=1))
    if len(foreign_ticks) and foreign_ticks[-1] > MAX_SETTLING_TICKS:
        violations.append(
            f"setpoints that the controller did not request in {len(foreign_ticks)} ticks, "
            f"up to {deviations_rad.max():.3g} rad away"
        )
    return violations


def _find_status_changes(quiet: ObservedPeriod, fuzzed: ObservedPeriod) -> list[str]:
    """Find a changed lifecycle or lease."""
    violations: list[str] = []
    first = quiet.first_status
    last = fuzzed.last_status
    if last.lifecycle != "armed":
        violations.append(f"lifecycle is {last.lifecycle}: {last.reason}")
    if (last.lease_holder, last.lease_epoch) != (first.lease_holder, first.lease_epoch):
        violations.append(
            f"the lease changed from {first.lease_holder}, epoch {first.lease_epoch}, to {last.lease_holder}, "
            f"epoch {last.lease_epoch}"
        )
    return violations


def _find_lost_payloads(report: ClientReport, payload_count: int) -> list[str]:
    """Find payloads that were not sent, and queries without a valid answer."""
    violations: list[str] = []
    sent_count = sum(report.samples_by_key.values()) + sum(report.queries_by_key.values())
    if sent_count != payload_count:
        violations.append(f"only {sent_count} of {payload_count} payloads were sent")
    if report.unanswered_count:
        violations.append(f"{report.unanswered_count} queries to the HAL got no answer")
    violations += [
        f"an answer {answer}"
        for answer in report.answers
        if answer not in ("yes", "no", "an error")
    ]
    return violations


def _find_excesses(quiet: ObservedPeriod, fuzzed: ObservedPeriod) -> list[str]:
    """Find memory, overruns and lost commands far above those of the quiet period."""
    violations: list[str] = []
    for part in fuzzed.vitals_by_part:
        quiet_growth_mb = max(quiet.compute_growth_mb(part), 0.0)
        excess_mb = fuzzed.compute_growth_mb(part) - quiet_growth_mb
        if excess_mb > MAX_GROWTH_MB:
            violations.append(
                f"{part} grew by {excess_mb:.1f} MB more than in the quiet period, at most {MAX_GROWTH_MB:g} MB"
            )
    overruns = fuzzed.fraction_of_ticks("overruns") - quiet.fraction_of_ticks("overruns")
    if overruns > MAX_OVERRUN_FRACTION:
        violations.append(_format_excess("overruns", overruns, MAX_OVERRUN_FRACTION))
    accepted_when_quiet = quiet.fraction_of_ticks("commands_accepted")
    lost_commands = accepted_when_quiet - fuzzed.fraction_of_ticks("commands_accepted")
    if lost_commands > MAX_LOST_COMMAND_FRACTION:
        violations.append(
            _format_excess("accepted commands", lost_commands, MAX_LOST_COMMAND_FRACTION)
        )
    return violations


def _format_excess(name: str, fraction: float, max_fraction: float) -> str:
    return (
        f"{name}: {100 * fraction:.2f} % of the ticks worse than in the quiet period, "
        f"at most {100 * max_fraction:g} %"
    )


def format_verdict(verdict: NetworkVerdict) -> str:
    """Format what was sent, how the two periods compare, and all violations."""
    lines = [
        f"machine   load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores",
        *_format_client_report(verdict.client_report),
        f"rejected  {_format_counts(verdict.host_record.rejected_commands)}",
        *_format_periods(verdict.quiet, verdict.fuzzed),
    ]
    lines += [f"VIOLATION {violation}" for violation in verdict.violations]
    if not verdict.violations:
        lines.append("no process ended, no log reports an error, no memory grew")
    return "\n".join(lines)


def _format_client_report(report: ClientReport) -> list[str]:
    sample_count = sum(report.samples_by_key.values())
    query_count = sum(report.queries_by_key.values())
    rate_hz = (sample_count + query_count) / max(report.duration_s, 1e-9)
    return [
        f"sent      {sample_count} samples and {query_count} queries, {report.sent_mb:.0f} MB, "
        f"in {report.duration_s:.0f} s: {rate_hz:.0f} a second",
        f"  samples   {_format_counts(report.samples_by_key)}",
        f"  queries   {_format_counts(report.queries_by_key)}",
        f"  mutations {_format_counts(report.payloads_by_mutation)}",
        f"  withheld  {_format_counts(report.withheld_by_effect)}: valid and effective, and therefore not sent",
        f"  answers   {_format_counts(report.answers)}; {report.unanswered_count} queries to the HAL without one",
    ]


def _format_periods(quiet: ObservedPeriod, fuzzed: ObservedPeriod) -> list[str]:
    first = quiet.first_status
    last = fuzzed.last_status
    lines = [
        f"lifecycle {last.lifecycle}: {last.reason}; lease of {last.lease_holder}, epoch {last.lease_epoch} "
        f"(before: {first.lease_holder}, {first.lease_epoch})",
        f"{'':10}{'quiet':>12}{'fuzzed':>12}",
        f"{'ticks':10}{quiet.count('tick'):>12}{fuzzed.count('tick'):>12}",
        f"{'accepted':10}{quiet.count('commands_accepted'):>12}{fuzzed.count('commands_accepted'):>12}",
        f"{'overruns':10}{quiet.count('overruns'):>12}{fuzzed.count('overruns'):>12}",
    ]
    for part in sorted(fuzzed.vitals_by_part):
        first_vitals = fuzzed.vitals_by_part[part][0]
        last_vitals = fuzzed.vitals_by_part[part][-1]
        lines.append(
            f"{part:10}{quiet.compute_growth_mb(part):>+9.1f} MB{fuzzed.compute_growth_mb(part):>+9.1f} MB  "
            f"now {last_vitals.resident_mb:.0f} MB, "
            f"{first_vitals.threads} -> {last_vitals.threads} threads, "
            f"{first_vitals.files} -> {last_vitals.files} files"
        )
    return lines


def _format_counts(counts: dict[str, int]) -> str:
    """Format counts by name, the largest first."""
    largest_first = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {name}" for name, count in largest_first) or "none"

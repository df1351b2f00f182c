"""What a soak finds: its events with their outcome, and all violations."""

import statistics
from collections import Counter
from dataclasses import dataclass, field

import msgspec


class EventOutcome(msgspec.Struct, kw_only=True):
    """What followed from one event; a line of the soak's log."""

    time_s: float  # since the begin of the soak
    event: str
    consequence: str  # which was expected
    answer: str  # to the request that injected the fault
    final_status: str = ""  # the lifecycle after the recovery, and its reason
    causes: list[str] = []  # of the faults that followed
    detected: bool = False
    recovery_s: float | None = None  # None if the robot did not recover
    violations: list[str] = []

    @property
    def fault_name(self) -> str:
        """The kind and the target of the fault, without its amount."""
        _, fault, *_ = self.event.split(" ")
        return fault.partition("=")[0]


@dataclass
class SoakResult:
    """All outcomes and violations of a soak."""

    seed: int
    outcomes: list[EventOutcome] = field(default_factory=list[EventOutcome])
    violations: list[str] = field(default_factory=list[str])
    impossible_faults: Counter[str] = field(default_factory=Counter[str])
    health_lines: list[str] = field(default_factory=list[str])
    watch_counts: Counter[str] = field(default_factory=Counter[str])
    duration_s: float = 0.0


def format_result(result: SoakResult) -> str:
    """Format a table of the faults by name, and all that was unusual."""
    recovery_times_s = _list_recovery_times_s(result.outcomes)
    lines = [
        *_format_fault_table(result.outcomes),
        _format_totals(result, recovery_times_s),
    ]
    lines += [f"not possible here: {fault}" for fault in sorted(result.impossible_faults)]
    lines += [
        f"counted: {event}, {count} times" for event, count in sorted(result.watch_counts.items())
    ]
    lines += result.health_lines
    lines += [f"VIOLATION {violation}" for violation in result.violations]
    if not result.violations:
        lines.append("every stop was explained, nothing grew, no process was left over")
    return "\n".join(lines)


def _format_fault_table(outcomes: list[EventOutcome]) -> list[str]:
    outcomes_by_fault: dict[str, list[EventOutcome]] = {}
    for outcome in outcomes:
        outcomes_by_fault.setdefault(outcome.fault_name, []).append(outcome)
    lines = [f"{'fault':<34}{'times':>6}{'stopped':>9}{'recovered':>11}{'slowest':>10}"]
    for fault, outcomes_of_fault in sorted(outcomes_by_fault.items()):
        detected_count = sum(outcome.detected for outcome in outcomes_of_fault)
        times_s = _list_recovery_times_s(outcomes_of_fault)
        slowest_s = max(times_s, default=float("nan"))
        lines.append(
            f"{fault:<34}{len(outcomes_of_fault):>6}{detected_count:>9}{len(times_s):>11}"
            f"{slowest_s:>8.1f} s"
        )
    return lines


def _format_totals(result: SoakResult, recovery_times_s: list[float]) -> str:
    median_s = statistics.median(recovery_times_s) if recovery_times_s else 0.0
    slowest_s = max(recovery_times_s, default=0.0)
    return (
        f"{len(result.outcomes)} faults in {result.duration_s / 60:.1f} minutes of seed {result.seed}; "
        f"recovered {len(recovery_times_s)} times, p50 {median_s:.1f} s, slowest {slowest_s:.1f} s"
    )


def _list_recovery_times_s(outcomes: list[EventOutcome]) -> list[float]:
    return [outcome.recovery_s for outcome in outcomes if outcome.recovery_s is not None]

"""A row of the fault table, the measurements of its trials, and the verdict on them."""

import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

Backend = Literal[
    "sim", "can", "both", "odrive", "moteus", "cia402", "dynamixel", "feetech", "mixed"
]
DRIVE_TYPES: tuple[Backend, ...] = (
    "can",
    "odrive",
    "moteus",
    "cia402",
    "dynamixel",
    "feetech",
    "mixed",
)

# Where a row is measured: in this process's environment, in network namespaces, or in a virtual machine with SocketCAN.
Environment = Literal["here", "namespaces", "guest"]

TRIALS = 20  # of each row and backend in a whole table


class InjectionTrial(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The measurement of one injection."""

    value: float | None  # in the row's unit; None: the expected reaction did not happen
    # How late the tick of the host was that reacted, on a busy computer. It is part of `value`, in the same unit.
    late_ms: float = 0.0
    failure: str = ""  # what else was wrong
    # By an operator's command; None: there was nothing to recover from.
    recovered: bool | None = None
    # Largest change of an applied angle target in a tick, after the recovery.
    step_rad: float | None = None
    # Largest distance of the first angle targets from the measured angles.
    first_rad: float | None = None


class RowResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The measurements of a row on one backend."""

    row: str
    backend: str
    when: str
    took_s: float
    load: float  # of the machine, at the beginning
    machine: str
    trials: list[InjectionTrial]
    # Trials that were repeated, see `MeasurementRequest.retry`; None: they were not counted then.
    retried: int | None = None
    notes: list[str] = []
    broken: str = ""  # why the measurement ended early


@dataclass
class MeasurementRequest:
    """A request to measure a row. The measurement adds its notes and its repeated trials."""

    backend: str
    trials: int
    folder: Path  # empty, for this measurement alone
    notes: list[str]  # remarks that the table shows with the row
    retried: int = 0

    def retry(self, times: int = 1) -> None:
        """Count repeated trials: an arming did not last, or the robot had stopped before the injection."""
        self.retried += times

    def note(self, text: str) -> None:
        """Add a remark, unless it was added before."""
        if text not in self.notes:
            self.notes.append(text)


Measure = Callable[[MeasurementRequest], Iterator[InjectionTrial]]
"""Yields the trials of a row as they are done."""


@dataclass(frozen=True, kw_only=True)
class FaultRow:
    """One row of the table: a fault, the expected reaction, and how it is measured on each backend."""

    name: str
    fault: str
    expected: str
    deadline: str  # in words, with how it is counted
    limit: float  # largest allowed value
    unit: str
    measures: Mapping[Backend, Measure | str]  # how it is measured, or why it does not apply
    environment: Environment = "here"
    min_trials: int = 0  # in a whole table of `TRIALS`

    def measurement(self, backend: Backend) -> Measure | None:
        """Return how the row is measured on a backend; None if it does not apply to the backend."""
        measure = self.measures.get(backend)
        return None if isinstance(measure, str) else measure

    def backends(self) -> list[Backend]:
        """Return the backends to which the row applies."""
        return [backend for backend in self.measures if self.measurement(backend) is not None]


@dataclass(frozen=True, kw_only=True)
class FaultHeading:
    """A fault as the page summarizes it. It may need several rows."""

    fault: str
    expected: str
    deadline: str
    rows: tuple[FaultRow, ...]


@dataclass(frozen=True, kw_only=True)
class RowVerdict:
    """Whether a row is met."""

    met: bool
    reason: str  # why it is not met; empty if it is
    median: float | None = None
    worst: float | None = None


def judge(row: FaultRow, result: RowResult) -> RowVerdict:
    """Return whether a row is met in all of its trials, and every objection if it is not."""
    values = [trial.value for trial in result.trials if trial.value is not None]
    failures = [trial.failure for trial in result.trials if trial.failure]
    too_late = sum(
        trial.value is not None and trial.value - trial.late_ms > row.limit
        for trial in result.trials
    )
    missing = sum(trial.value is None for trial in result.trials)
    not_recovered = sum(trial.recovered is False for trial in result.trials)

    objections: list[str] = []
    if too_late:
        objections.append(f"{too_late} of {len(values)} trials over {row.limit:g} {row.unit}")
    if result.broken:
        objections.append(result.broken)
    if missing:
        objections.append(f"nothing measured in {missing} of {len(result.trials)} trials")
    if failures:
        objections.append(f"{len(failures)} of {len(result.trials)} trials: {failures[0]}")
    if not_recovered:
        objections.append(f"no recovery in {not_recovered} trials")
    if not result.trials and not result.broken:
        objections.append("no trial")
    return RowVerdict(
        met=not objections,
        reason="; ".join(objections),
        median=statistics.median(values) if values else None,
        worst=max(values, default=None),
    )

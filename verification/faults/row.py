"""Defines a row of the fault table, the results of its measurement, and the verdict on them."""

import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

Backend = Literal[
    "sim", "can", "both", "odrive", "moteus", "cia402", "dynamixel", "feetech", "mixed"
]
"""Where a row is measured. `both`: once, in code that the backends sim and can share."""

DRIVE_TYPES: tuple[Backend, ...] = (
    "can",
    "odrive",
    "moteus",
    "cia402",
    "dynamixel",
    "feetech",
    "mixed",
)

Environment = Literal["here", "namespaces", "guest"]
"""Where the measuring process runs: on this machine, in network namespaces, or in a virtual machine with SocketCAN."""

TRIALS = 20  # of each row and backend in a complete table


class InjectionTrial(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The result of one injected fault."""

    # Measured value in the unit of the row. None: the expected reaction did not happen.
    value: float | None
    # By how much a busy computer delayed the tick that reacted. It is a part of `value`, in the same unit.
    late_ms: float = 0.0
    # Every other condition that was not met, or an empty text.
    failure: str = ""
    # Whether an operator could reset and arm the robot. None: nothing had to recover.
    recovered: bool | None = None
    # Largest change of an applied angle target from one tick to the next, after the recovery.
    step_rad: float | None = None
    # Largest distance of the first angle targets from the measured angles, after the recovery.
    first_rad: float | None = None


class RowResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The result of a row on one backend."""

    row: str
    backend: str
    when: str  # date and time
    took_s: float
    load: float  # load average of the machine at the beginning
    machine: str
    trials: list[InjectionTrial]
    # Number of repeated trials, see `MeasurementRequest.count_retries`. None: older results do not contain it.
    retried: int | None = None
    notes: list[str] = []
    broken: str = ""  # exception that ended the measurement early


@dataclass
class MeasurementRequest:
    """A request to measure a row. The measurement adds its notes, and counts its repeated trials."""

    backend: str
    trials: int
    folder: Path  # an empty folder for this measurement
    notes: list[str]  # remarks that the table shows with the row
    retried: int = 0

    def count_retries(self, count: int = 1) -> None:
        """Count trials that were repeated because the robot had stopped before the injection."""
        self.retried += count

    def add_note(self, text: str) -> None:
        """Add a remark, unless it was added before."""
        if text not in self.notes:
            self.notes.append(text)


Measure = Callable[[MeasurementRequest], Iterator[InjectionTrial]]
"""Measures a row, and yields each trial as soon as it is over."""


@dataclass(frozen=True, kw_only=True)
class FaultRow:
    """One row of the table: a fault, the expected reaction, and how it is measured on each backend."""

    name: str
    fault: str
    expected: str
    deadline: str  # as text, with its start and its end
    limit: float  # largest allowed value
    unit: str  # of the limit and the measured values
    measures: Mapping[Backend, Measure | str]  # how it is measured, or why it does not apply
    environment: Environment = "here"
    min_trials: int = 0  # in a complete table, if more than TRIALS

    def get_measure(self, backend: Backend) -> Measure | None:
        """Return how the row is measured on a backend, or None if it does not apply to the backend."""
        measure = self.measures.get(backend)
        return None if isinstance(measure, str) else measure

    def list_backends(self) -> list[Backend]:
        """Return the backends to which the row applies."""
        return [backend for backend in self.measures if self.get_measure(backend) is not None]


@dataclass(frozen=True, kw_only=True)
class FaultHeading:
    """A fault as the page summarizes it, with the rows that measure it."""

    fault: str
    expected: str
    deadline: str
    rows: tuple[FaultRow, ...]


@dataclass(frozen=True, kw_only=True)
class RowVerdict:
    """Whether a row is met, and its typical and worst value."""

    met: bool
    reason: str  # why it is not met, or an empty text
    median: float | None = None
    worst: float | None = None


def judge_row(row: FaultRow, result: RowResult) -> RowVerdict:
    """Judge a row: it is met if every trial is within the limit, without a failure, and recovered.

    The delay of a busy computer does not count towards the limit.
    """
    trial_count = len(result.trials)
    values = [trial.value for trial in result.trials if trial.value is not None]
    failures = [trial.failure for trial in result.trials if trial.failure]
    late_count = sum(_exceeds_limit(trial, row) for trial in result.trials)
    missing_count = trial_count - len(values)
    not_recovered_count = sum(trial.recovered is False for trial in result.trials)

    objections: list[str] = []
    if late_count:
        objections.append(f"{late_count} of {len(values)} trials over {row.limit:g} {row.unit}")
    if result.broken:
        objections.append(result.broken)
    if missing_count:
        objections.append(f"nothing measured in {missing_count} of {trial_count} trials")
    if failures:
        objections.append(f"{len(failures)} of {trial_count} trials: {failures[0]}")
    if not_recovered_count:
        objections.append(f"no recovery in {not_recovered_count} trials")
    if not result.trials and not result.broken:
        objections.append("no trial")
    return RowVerdict(
        met=not objections,
        reason="; ".join(objections),
        median=statistics.median(values) if values else None,
        worst=max(values, default=None),
    )


def _exceeds_limit(trial: InjectionTrial, row: FaultRow) -> bool:
    return trial.value is not None and trial.value - trial.late_ms > row.limit

"""What a row of the fault table is, and what its trials leave."""

import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

Backend = Literal["sim", "can", "both", "odrive", "moteus", "dynamixel", "mixed"]
DRIVE_TYPES: tuple[Backend, ...] = ("can", "odrive", "moteus", "dynamixel", "mixed")
Place = Literal["here", "namespaces", "guest"]
TRIALS = 20  # of each row and backend in a whole table


class Trial(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One injection."""

    value: float | None  # in the row's unit; None: what should have happened did not
    failure: str = ""  # what else was wrong
    recovered: bool | None = None  # by an operator's command; None: there was nothing to recover from
    step_rad: float | None = None  # largest change of an applied angle target in a tick, after the recovery
    first_rad: float | None = None  # largest distance of the first angle targets from the measured angles


class Result(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A row on a backend, as it was measured."""

    row: str
    backend: str
    when: str
    took_s: float
    load: float  # the machine's, when it began
    machine: str
    trials: list[Trial]
    retried: int | None = None  # trials that were made again, see `Request.retry`; None: it was not counted then
    notes: list[str] = []
    broken: str = ""  # why it ended early


@dataclass
class Request:
    """What a measurement is asked for, and what it tells besides its trials."""

    backend: str
    trials: int
    folder: Path  # its own, empty
    notes: list[str]  # what should stand beside the row
    retried: int = 0

    def retry(self, times: int = 1) -> None:
        """A trial is made again: its arming did not last, or the robot had stopped before anything was injected."""
        self.retried += times

    def note(self, text: str) -> None:
        """Once, however often it is said."""
        if text not in self.notes:
            self.notes.append(text)


Measure = Callable[[Request], Iterator[Trial]]


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    fault: str
    expected: str
    deadline: str  # in words, with how it is counted
    limit: float  # the worst value allowed
    unit: str
    on: Mapping[Backend, Measure | str]  # how it is measured, or why it does not apply
    place: Place = "here"
    least: int = 0  # trials in a whole table of 20; fewer where fewer are asked for


@dataclass(frozen=True)
class Verdict:
    """Whether a row is met."""

    met: bool
    why: str
    median: float | None = None
    worst: float | None = None


def judge(row: Row, result: Result) -> Verdict:
    """By the worst trial."""
    values = [trial.value for trial in result.trials if trial.value is not None]
    median = statistics.median(values) if values else None
    worst = max(values) if values else None
    against: list[str] = []
    over = [value for value in values if value > row.limit]
    if over:
        against.append(f"{len(over)} of {len(values)} trials over {row.limit:g} {row.unit}")
    if result.broken:
        against.append(result.broken)
    missing = sum(trial.value is None for trial in result.trials)
    if missing:
        against.append(f"nothing measured in {missing} of {len(result.trials)} trials")
    failures = [trial.failure for trial in result.trials if trial.failure]
    if failures:
        against.append(f"{len(failures)} of {len(result.trials)} trials: {failures[0]}")
    stuck = sum(trial.recovered is False for trial in result.trials)
    if stuck:
        against.append(f"no recovery in {stuck} trials")
    if not result.trials and not result.broken:
        against.append("no trial")
    return Verdict(not against, "; ".join(against), median, worst)

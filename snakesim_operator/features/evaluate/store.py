"""Keeps outcomes on disk: a line for each trial as it is finished, and at the end a table for other programs."""

import csv
import fcntl
import os
import types
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.features.evaluate.trial import (
    ENDED_BY_STALL_METRIC,
    WALL_CLOCK_METRICS,
    EvaluationTrial,
    MetricValue,
    TrialOutcome,
)
from snakesim_operator.results.signals import PARQUET_UNIT
from snakesim_operator.results.summary import RunSummary

TRIALS_FILENAME = "trials.jsonl"
# Name of the file of finished trials before the first release. Its lines cannot be continued: they are of other code.
FORMER_TRIALS_FILENAME = "cases.jsonl"
PARQUET_FILENAME = "results.parquet"
CSV_FILENAME = "results.csv"
OutcomeById = dict[str, TrialOutcome]  # by the id of the trial
ARROW_TYPE_BY_TYPE = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


class _StoredTrial(msgspec.Struct, frozen=True):
    """A line of the file of finished trials."""

    id: str
    outcome: TrialOutcome
    trial: dict[str, MetricValue] = {}  # the columns that identify the trial, for readers


class ResultStore:
    """The file of finished trials, open for appending."""

    def __init__(self, file_descriptor: int, outcome_by_id: OutcomeById) -> None:
        self._file_descriptor = file_descriptor
        self.outcome_by_id = outcome_by_id

    def append(self, trial: EvaluationTrial, outcome: TrialOutcome) -> None:
        """Store a finished trial; it is on the disk when this returns."""
        line = _StoredTrial(trial.id, outcome, trial.identifying_columns)
        os.write(self._file_descriptor, msgspec.json.encode(line) + b"\n")
        os.fsync(self._file_descriptor)
        self.outcome_by_id[trial.id] = outcome


@contextmanager
def open_store(folder: Path, *, resume: bool) -> Iterator[ResultStore]:
    """Open the results in an evaluation's folder, and lock them for this process alone.

    Args:
        folder: Path of the evaluation's folder, which is made if it is missing.
        resume: Whether the folder may hold results already.

    Raises:
        ConfigError: The folder cannot be used, holds an evaluation, or another process writes there.
    """
    if (folder / FORMER_TRIALS_FILENAME).exists():
        raise ConfigError(
            f"--out {folder} holds an evaluation of an older version of SnakeSIM, which cannot be continued; "
            "choose another folder",
            code="file/already-exists",
        )
    path = folder / TRIALS_FILENAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file_descriptor = os.open(
            path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644
        )
    except OSError as error:
        raise ConfigError(
            f"--out {folder}: {error.strerror}; choose another folder", code="file/not-writable"
        ) from None
    try:
        fcntl.flock(file_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(file_descriptor).st_size and not resume:
            raise ConfigError(
                f"--out {folder} holds an evaluation; continue it with --resume, or choose another folder",
                code="file/already-exists",
            )
        yield ResultStore(file_descriptor, _read_outcomes(path, file_descriptor))
    except BlockingIOError:
        raise ConfigError(
            f"--out {folder}: another evaluation is writing there; choose another folder",
            code="file/in-use",
        ) from None
    finally:
        os.close(file_descriptor)


def _read_outcomes(path: Path, file_descriptor: int) -> OutcomeById:
    """Return the outcomes of finished trials.

    A last line that is incomplete, because the process was killed, is removed. A trial that could not run is left out,
    so that it is tried again.
    """
    content = path.read_bytes()
    os.ftruncate(file_descriptor, content.rfind(b"\n") + 1)
    outcome_by_id: OutcomeById = {}
    for text in content.split(b"\n")[:-1]:
        with suppress(msgspec.DecodeError):
            line = msgspec.json.decode(text, type=_StoredTrial)
            if line.outcome.error is None:
                outcome_by_id[line.id] = line.outcome
    return outcome_by_id


def write_tables(
    folder: Path, trials: Sequence[EvaluationTrial], outcome_by_id: OutcomeById
) -> list[Path]:
    """Write the results in the order of the trials, as Parquet and as CSV.

    No value depends on the wall clock, so two evaluations of the same trials give the same files.

    Args:
        folder: Path of the evaluation's folder.
        trials: All trials; those without an outcome are left out.
        outcome_by_id: Outcome of each finished trial by its id.

    Returns:
        The paths of the two files.
    """
    type_by_column = _find_column_types()
    rows: list[dict[str, MetricValue]] = []
    for trial in trials:
        if trial.id in outcome_by_id:
            outcome = outcome_by_id[trial.id]
            rows.append({**outcome.metrics, **trial.identifying_columns, "error": outcome.error})
    parquet_path = folder / PARQUET_FILENAME
    csv_path = folder / CSV_FILENAME
    unit_by_column = _find_units()
    arrow_fields = [
        pa.field(column, arrow_type, metadata=_make_unit_metadata(unit_by_column.get(column)))
        for column, arrow_type in type_by_column.items()
    ]
    schema = pa.schema(arrow_fields)
    with export_atomically(parquet_path) as temporary_path:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), temporary_path)
    with (
        export_atomically(csv_path) as temporary_path,
        temporary_path.open("x", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(
            file, list(type_by_column), extrasaction="ignore", lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(rows)
    return [parquet_path, csv_path]


def _find_column_types() -> dict[str, Any]:
    """Return name and Arrow type of each column of the table of results.

    The first columns identify a trial. They are followed by the plain values of a run's summary that do not depend on
    the wall clock.
    """
    type_by_column = {
        "condition_number": ARROW_TYPE_BY_TYPE[int],
        "condition_name": ARROW_TYPE_BY_TYPE[str],
        "controller": ARROW_TYPE_BY_TYPE[str],
        "seed": ARROW_TYPE_BY_TYPE[int],
    }
    for name, hint in typing.get_type_hints(RunSummary).items():
        if name in WALL_CLOCK_METRICS:
            continue
        alternatives = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        # A column may be empty, so only the type besides None counts.
        value_types = [
            alternative for alternative in alternatives if alternative is not types.NoneType
        ]
        is_plain = len(value_types) == 1 and value_types[0] in ARROW_TYPE_BY_TYPE
        if is_plain:
            type_by_column.setdefault(name, ARROW_TYPE_BY_TYPE[value_types[0]])
    type_by_column[ENDED_BY_STALL_METRIC] = ARROW_TYPE_BY_TYPE[bool]
    type_by_column["error"] = ARROW_TYPE_BY_TYPE[str]
    return type_by_column


def _find_units() -> dict[str, str]:
    """Return the unit of each number of a run's summary that has one."""
    unit_by_name: dict[str, str] = {}
    for name, hint in typing.get_type_hints(RunSummary, include_extras=True).items():
        for note in getattr(hint, "__metadata__", ()):
            unit = (note.extra_json_schema or {}).get("unit")
            if unit is not None:
                unit_by_name[name] = unit
    return unit_by_name


def _make_unit_metadata(unit: str | None) -> dict[bytes, bytes] | None:
    """Return the metadata of a column of Parquet."""
    if unit is None:
        return None
    return {PARQUET_UNIT: unit.encode()}

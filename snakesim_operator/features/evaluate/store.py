"""Keeps results on disk: a line for each case as it is done, and at the end a table for other programs."""

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
from snakesim_operator.features.evaluate.case import (
    GAVE_UP_FIELD,
    WALL_CLOCK_FIELDS,
    CaseOutcome,
    EvaluationCase,
    Number,
)
from snakesim_operator.results.signals import PARQUET_UNIT
from snakesim_operator.results.summary import RunSummary

CASES_FILENAME = "cases.jsonl"
PARQUET_FILENAME = "results.parquet"
CSV_FILENAME = "results.csv"
Results = dict[str, CaseOutcome]  # by the case's id
ARROW_TYPE_BY_TYPE = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


class _StoredCase(msgspec.Struct, frozen=True):
    """A line of the file of finished cases."""

    id: str
    outcome: CaseOutcome
    numbers: dict[str, Number] = {}


class ResultStore:
    """The file of finished cases, open for appending."""

    def __init__(self, handle: int, done: Results) -> None:
        self._file_descriptor = handle
        self.done = done

    def append(self, case: EvaluationCase, outcome: CaseOutcome) -> None:
        """Store a finished case; it is on the disk when this returns."""
        line = _StoredCase(case.id, outcome, case.identifying_columns)
        os.write(self._file_descriptor, msgspec.json.encode(line) + b"\n")
        os.fsync(self._file_descriptor)
        self.done[case.id] = outcome


@contextmanager
def open_store(folder: Path, *, resume: bool) -> Iterator[ResultStore]:
    """Open the results in an evaluation's folder, and lock them for this process alone.

    Args:
        folder: Path of the evaluation's folder, which is made if it is missing.
        resume: Whether the folder may hold results already.

    Raises:
        ConfigError: The folder cannot be used, holds an evaluation, or another process writes there.
    """
    path = folder / CASES_FILENAME
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
        yield ResultStore(file_descriptor, _read_results(path, file_descriptor))
    except BlockingIOError:
        raise ConfigError(
            f"--out {folder}: another evaluation is writing there; choose another folder",
            code="file/in-use",
        ) from None
    finally:
        os.close(file_descriptor)


def _read_results(path: Path, file_descriptor: int) -> Results:
    """Return the results of finished cases.

    A last line that is incomplete, because the process was killed, is removed. A case without a run is left out, so
    that it is tried again.
    """
    content = path.read_bytes()
    os.ftruncate(file_descriptor, content.rfind(b"\n") + 1)
    outcome_by_id: Results = {}
    for text in content.split(b"\n")[:-1]:
        with suppress(msgspec.DecodeError):
            line = msgspec.json.decode(text, type=_StoredCase)
            if line.outcome.error is None:
                outcome_by_id[line.id] = line.outcome
    return outcome_by_id


def write_tables(
    folder: Path, cases: Sequence[EvaluationCase], outcome_by_id: Results
) -> list[Path]:
    """Write the results in the order of the cases, as Parquet and as CSV.

    No value depends on the wall clock, so two evaluations of the same cases give the same files.

    Args:
        folder: Path of the evaluation's folder.
        cases: All cases; those without a result are left out.
        outcome_by_id: Outcome of each finished case by its id.

    Returns:
        The paths of the two files.
    """
    columns = _find_column_types()
    rows: list[dict[str, Number]] = []
    for case in cases:
        if case.id in outcome_by_id:
            outcome = outcome_by_id[case.id]
            rows.append({**outcome.numbers, **case.identifying_columns, "error": outcome.error})
    parquet_path = folder / PARQUET_FILENAME
    csv_path = folder / CSV_FILENAME
    units = _find_units()
    fields = [
        pa.field(name, type_, metadata=_make_unit_metadata(units.get(name)))
        for name, type_ in columns.items()
    ]
    schema = pa.schema(fields)
    with export_atomically(parquet_path) as temporary_path:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), temporary_path)
    with (
        export_atomically(csv_path) as temporary_path,
        temporary_path.open("x", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, list(columns), extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return [parquet_path, csv_path]


def _find_column_types() -> dict[str, Any]:
    """Return name and Arrow type of each column of the table of results.

    The first columns identify a case. Then follow the fields of a run's summary that are plain values and do not
    depend on the wall clock.
    """
    columns = {
        "row": ARROW_TYPE_BY_TYPE[int],
        "setting": ARROW_TYPE_BY_TYPE[str],
        "controller": ARROW_TYPE_BY_TYPE[str],
        "field": ARROW_TYPE_BY_TYPE[int],
    }
    for name, hint in typing.get_type_hints(RunSummary).items():
        if name in WALL_CLOCK_FIELDS:
            continue
        alternatives = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        # A column may be empty, so only the type besides None counts.
        value_types = [
            alternative for alternative in alternatives if alternative is not types.NoneType
        ]
        is_plain = len(value_types) == 1 and value_types[0] in ARROW_TYPE_BY_TYPE
        if is_plain:
            columns.setdefault(name, ARROW_TYPE_BY_TYPE[value_types[0]])
    columns[GAVE_UP_FIELD] = ARROW_TYPE_BY_TYPE[bool]
    columns["error"] = ARROW_TYPE_BY_TYPE[str]
    return columns


def _find_units() -> dict[str, str]:
    """Return the unit of each number of a run's summary that has one."""
    units: dict[str, str] = {}
    for name, hint in typing.get_type_hints(RunSummary, include_extras=True).items():
        for note in getattr(hint, "__metadata__", ()):
            unit = (note.extra_json_schema or {}).get("unit")
            if unit is not None:
                units[name] = unit
    return units


def _make_unit_metadata(unit: str | None) -> dict[bytes, bytes] | None:
    """Return the metadata of a column of Parquet."""
    return None if unit is None else {PARQUET_UNIT: unit.encode()}

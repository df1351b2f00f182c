"""Results on disk: a line a case as it is done, and at the end a table for other programs."""

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
from snakesim_hal.model.textfiles import exported
from snakesim_operator.features.evaluate.case import GAVE_UP, OF_THE_CLOCK, Case, Number, Outcome
from snakesim_operator.results.summary import RunSummary

CASES, PARQUET, CSV = "cases.jsonl", "results.parquet", "results.csv"
Results = dict[str, Outcome]  # by the case's id
ARROW = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


class _Line(msgspec.Struct, frozen=True):
    id: str
    outcome: Outcome
    about: dict[str, Number] = {}


class Store:
    """The file of finished cases, open for more of them."""

    def __init__(self, handle: int, done: Results) -> None:
        self._handle = handle
        self.done = done

    def add(self, case: Case, outcome: Outcome) -> None:
        """Keep a finished case; it is on the disk when this returns."""
        line = _Line(case.id, outcome, case.columns)
        os.write(self._handle, msgspec.json.encode(line) + b"\n")
        os.fsync(self._handle)
        self.done[case.id] = outcome


@contextmanager
def opened(folder: Path, *, resume: bool) -> Iterator[Store]:
    """Hold a folder's results. Raises ConfigError when they are another evaluation's."""
    path = folder / CASES
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    except OSError as error:
        raise ConfigError(f"--out {folder}: {error.strerror}; choose another folder") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(handle).st_size and not resume:
            raise ConfigError(
                f"--out {folder} holds an evaluation; go on with it by --resume, or choose another folder"
            )
        yield Store(handle, _read(path, handle))
    except BlockingIOError:
        raise ConfigError(f"--out {folder}: another evaluation is writing there; choose another folder") from None
    finally:
        os.close(handle)


def _read(path: Path, handle: int) -> Results:
    """What is done. A last line that a kill has cut is removed; a case without a run is tried again."""
    content = path.read_bytes()
    os.ftruncate(handle, content.rfind(b"\n") + 1)
    done: Results = {}
    for text in content.split(b"\n")[:-1]:
        with suppress(msgspec.DecodeError):
            line = msgspec.json.decode(text, type=_Line)
            if line.outcome.error is None:
                done[line.id] = line.outcome
    return done


def write_tables(folder: Path, cases: Sequence[Case], done: Results) -> list[Path]:
    """Results in the order of the cases, as Parquet and CSV; nothing in them depends on the clock."""
    columns = _columns()
    finished = [(case, done[case.id]) for case in cases if case.id in done]
    rows = [{**one.numbers, **case.columns, "error": one.error} for case, one in finished]
    paths = [folder / PARQUET, folder / CSV]
    schema = pa.schema(list(columns.items()))
    with exported(paths[0]) as partial:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), partial)
    with exported(paths[1]) as partial, partial.open("x", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return paths


def _columns() -> dict[str, Any]:
    """Names and types: what identifies a case, then every plain field of a summary."""
    found = {"row": ARROW[int], "setting": ARROW[str], "controller": ARROW[str], "field": ARROW[int]}
    for name, hint in typing.get_type_hints(RunSummary).items():
        either = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        plain = [one for one in either if one is not types.NoneType]
        if name not in OF_THE_CLOCK and len(plain) == 1 and plain[0] in ARROW:
            found.setdefault(name, ARROW[plain[0]])
    return {**found, GAVE_UP: ARROW[bool], "error": ARROW[str]}

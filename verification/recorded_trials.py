"""Trials with many robots whose results are kept in a file, so that a later command continues where one ended."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec


class RobotTrial(Protocol):
    """The result of a trial with one robot."""

    @property
    def backend(self) -> str:
        """The backend of the run, which is the type of the drives."""
        ...

    @property
    def number(self) -> int:
        """The number of the robot, which is its seed."""
        ...


ResultT = TypeVar("ResultT")
TrialT = TypeVar("TrialT", bound=RobotTrial)


def append_result(path: Path, result: msgspec.Struct) -> None:
    """Append a result to a file, as one line of JSON."""
    with path.open("ab") as file:
        file.write(msgspec.json.encode(result) + b"\n")


def read_results(path: Path, result_type: type[ResultT]) -> list[ResultT]:
    """Return all results in a file; none if it does not exist."""
    if not path.exists():
        return []
    return msgspec.json.Decoder(result_type).decode_lines(path.read_bytes())


def run_missing_trials(
    numbers: Iterable[int],
    backend: str,
    record: Path | None,
    result_type: type[TrialT],
    run_trial: Callable[[int], TrialT],
) -> list[TrialT]:
    """Run the trials that a file does not contain yet, and return the results of all.

    Args:
        numbers: Numbers of the robots.
        backend: Backend of the trials. The file may also contain other backends.
        record: File with the results of earlier trials. None: all trials are run.
        result_type: Type of the results in the file.
        run_trial: Runs the trial with the robot of this number, and appends its result to the file.
    """
    known_results: dict[int, TrialT] = {}
    if record is not None:
        recorded = read_results(record, result_type)
        known_results = {result.number: result for result in recorded if result.backend == backend}
    return [
        known_results[number] if number in known_results else run_trial(number)
        for number in numbers
    ]

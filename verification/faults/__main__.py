"""`python -m verification.faults [--rows NAME ...] [--backends sim can] [--trials 20] [--write]`.

Exit code 1 when a row that was run is not met.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, get_args

from verification.faults.results import ROOT, FaultResults, machine
from verification.faults.row import (
    TRIALS,
    Backend,
    Environment,
    FaultRow,
    InjectionTrial,
    MeasurementRequest,
    RowResult,
    judge,
)
from verification.faults.table import ROWS

# Set in a process that was started to measure rows in another environment: the name of this environment.
ENVIRONMENT_VARIABLE = "SNAKESIM_FAULTS_ENVIRONMENT"

# Commands that run a program in another environment.
ENVIRONMENT_COMMANDS: dict[Environment, list[str]] = {
    "namespaces": ["unshare", "--net", "--mount"],
    "guest": [sys.executable, str(ROOT / "deploy/vm/with_vcan.py"), "--guest"],
}
ENVIRONMENT_LIMIT_S = 2400.0  # for all rows of one environment
LOG_CHARACTERS = 800  # of each log, after an error

Measurement = tuple[FaultRow, Backend]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure rows one after the other: first those of this environment, then those of each other environment.

    Returns:
        0 if every measured row is met, 1 otherwise.
    """
    arguments = _parse_arguments(argv)
    store = FaultResults(arguments.json)
    measurements = _select_measurements(arguments.rows or list(ROWS), arguments.backends)
    started_in = os.environ.get(ENVIRONMENT_VARIABLE)

    not_met: list[str] = []
    for row, backend in measurements:
        if row.environment in ("here", started_in):
            store.save(_measure_row(row, backend, arguments.trials))
            not_met += _print_result(row, backend, store)
    if started_in is not None:
        return 0  # the process that started this one reports

    for environment in ENVIRONMENT_COMMANDS:
        in_environment: list[Measurement] = [
            (row, backend) for row, backend in measurements if row.environment == environment
        ]
        if in_environment:
            _measure_in_environment(environment, in_environment, arguments.trials, store)
            for row, backend in in_environment:
                not_met += _print_result(row, backend, store)
    if arguments.write:
        from verification.faults.page import write

        print(write(store))
    print(f"not met: {', '.join(not_met)}" if not_met else "every row that was run is met")
    return 1 if not_met else 0


def _select_measurements(
    row_names: Sequence[str], only_backends: Sequence[str] | None
) -> list[Measurement]:
    """Return rows with each backend on which they are measured. only_backends: None or empty: all."""
    measurements: list[Measurement] = []
    for name in row_names:
        for backend in ROWS[name].backends():
            if not only_backends or backend in only_backends:
                measurements.append((ROWS[name], backend))
    return measurements


def _measure_row(row: FaultRow, backend: Backend, trial_count: int) -> RowResult:
    """Measure a row on a backend. An exception ends the measurement, and is part of its result."""
    measure = row.measurement(backend)
    assert measure is not None, f"{row.name} does not apply to {backend}"
    if trial_count >= TRIALS:
        trial_count = max(trial_count, row.min_trials)
    started_s = time.monotonic()
    load = _machine_load()
    done: list[InjectionTrial] = []
    broken = ""
    print(f"{datetime.now():%H:%M:%S} {row.name} on {backend} ...", flush=True)
    with tempfile.TemporaryDirectory(prefix=f"snakesim-{row.name}-") as folder:
        request = MeasurementRequest(backend, trial_count, Path(folder), [])
        try:
            for trial in measure(request):
                done.append(trial)
                if trial.failure:
                    print(f"    {trial.failure}", flush=True)
        except Exception as error:  # noqa: BLE001 - an exception is a result, and the other rows continue
            _print_error(error, Path(folder))
            broken = f"{type(error).__name__}: {error}"[:500]
    return _make_result(
        row,
        backend,
        took_s=round(time.monotonic() - started_s, 1),
        load=load,
        trials=done,
        retried=request.retried,
        notes=request.notes,
        broken=broken,
    )


def _machine_load() -> float:
    """Return the load of the machine over the last minute."""
    return round(os.getloadavg()[0], 2)


def _print_error(error: Exception, folder: Path) -> None:
    """Print where an exception was raised, and the end of every log in a folder."""
    traceback.print_tb(error.__traceback__)
    print(f"{type(error).__name__}: {str(error)[:1000]}", file=sys.stderr)
    for log in folder.glob("*.log"):
        print(f"{log.name}: {log.read_text(errors='replace')[-LOG_CHARACTERS:]}", file=sys.stderr)
    sys.stderr.flush()


def _measure_in_environment(
    environment: Environment,
    measurements: Sequence[Measurement],
    trial_count: int,
    store: FaultResults,
) -> None:
    """Measure rows by a process in another environment, which writes its results into the same file."""
    before = store.read()
    command = [*ENVIRONMENT_COMMANDS[environment]]
    if environment == "guest":
        command += [*_writable_folder_options(store), "--"]
    command += [
        "env",
        f"{ENVIRONMENT_VARIABLE}={environment}",
        sys.executable,
        "-m",
        "verification.faults",
    ]
    command += ["--rows", *dict.fromkeys(row.name for row, _ in measurements)]
    command += ["--backends", *dict.fromkeys(backend for _, backend in measurements)]
    command += ["--trials", str(trial_count), "--json", str(store.path)]
    try:
        subprocess.run(command, cwd=ROOT, check=False, timeout=ENVIRONMENT_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(f"    {error}", flush=True)

    after = store.read()
    for row, backend in measurements:
        if after.get((row.name, backend)) == before.get((row.name, backend)):
            store.save(
                _make_result(row, backend, broken=f"no result from the environment {environment!r}")
            )


def _writable_folder_options(store: FaultResults) -> list[str]:
    """Return the options with which a guest may write into the folder of the results, if it is not in the checkout."""
    folder = store.path.resolve().parent
    if folder.is_relative_to(ROOT):
        return []
    return ["--rwdir", str(folder)]


def _make_result(row: FaultRow, backend: Backend, **measured: Any) -> RowResult:
    """Return a result of now; `measured` replaces the values of a result without trials."""
    values: dict[str, Any] = {"took_s": 0.0, "load": _machine_load(), "trials": []}
    values |= measured
    return RowResult(
        row=row.name,
        backend=backend,
        when=f"{datetime.now():%Y-%m-%d %H:%M}",
        machine=machine(),
        **values,
    )


def _print_result(row: FaultRow, backend: Backend, store: FaultResults) -> list[str]:
    """Print the result of a row. Returns row and backend in words if the row is not met, otherwise nothing."""
    result = store.read()[row.name, backend]
    verdict = judge(row, result)
    figures = ""
    if verdict.median is not None:
        figures = f"median {verdict.median:.1f}, worst {verdict.worst:.1f} {row.unit}, "
    retried = f", {result.retried} retried" if result.retried else ""
    outcome = "met" if verdict.met else f"NOT MET: {verdict.reason}"
    trials = f"{len(result.trials)} trials{retried} in {result.took_s:.0f} s"
    print(f"    {row.name} on {backend}: {figures}{trials}: {outcome}", flush=True)
    return [] if verdict.met else [f"{row.name} on {backend}"]


def _parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m verification.faults", description=__doc__)
    parser.add_argument(
        "--rows", nargs="+", choices=list(ROWS), metavar="NAME", help=f"of {', '.join(ROWS)}"
    )
    parser.add_argument(
        "--backends", nargs="+", choices=get_args(Backend), metavar="NAME", help="only on these"
    )
    parser.add_argument(
        "--trials", type=int, default=TRIALS, help=f"of each row and backend ({TRIALS})"
    )
    parser.add_argument(
        "--write",
        action="store_true",
        help="write docs/benchmarks/faults.md and docs/benchmarks/fault-table.csv from all results",
    )
    parser.add_argument(
        "--json",
        type=Path,
        default=FaultResults().path,
        help="raw results (docs/benchmarks/faults.json)",
    )
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())

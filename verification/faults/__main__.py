"""Measures rows of the fault table one after the other, and prints whether each of them is met.

The exit code is 0 if every measured row is met, and 1 otherwise.
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

from verification.faults.results import ROOT, FaultResults, describe_machine
from verification.faults.row import (
    TRIALS,
    Backend,
    Environment,
    FaultRow,
    InjectionTrial,
    MeasurementRequest,
    RowResult,
    judge_row,
)
from verification.faults.table import ROWS

# Set in a process that was started to measure rows in another environment: the name of this environment.
ENVIRONMENT_VARIABLE = "SNAKESIM_FAULTS_ENVIRONMENT"

# Commands that run a program in another environment.
ENVIRONMENT_COMMANDS: dict[Environment, list[str]] = {
    "namespaces": ["unshare", "--net", "--mount"],
    "guest": [sys.executable, str(ROOT / "deploy/vm/with_vcan.py"), "--guest"],
}
ENVIRONMENT_TIMEOUT_S = 2400.0  # for all rows of one environment

# Printed or stored after an error.
MAX_LOG_CHARACTERS = 800
MAX_PRINTED_ERROR_CHARACTERS = 1000
MAX_STORED_ERROR_CHARACTERS = 500

Measurement = tuple[FaultRow, Backend]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the rows of this environment, then those of each other environment.

    Returns:
        0 if every measured row is met, 1 otherwise.
    """
    arguments = _parse_arguments(argv)
    store = FaultResults(arguments.json)
    measurements = _select_measurements(arguments.rows or list(ROWS), arguments.backends)
    this_environment = os.environ.get(ENVIRONMENT_VARIABLE)

    not_met: list[str] = []
    for row, backend in measurements:
        if row.environment in ("here", this_environment):
            store.save(_measure_row(row, backend, arguments.trials))
            if not _print_result(row, backend, store):
                not_met.append(f"{row.name} on {backend}")
    if this_environment is not None:
        return 0  # the process that started this one judges the results

    for environment in ENVIRONMENT_COMMANDS:
        selected = [pair for pair in measurements if pair[0].environment == environment]
        if not selected:
            continue
        _measure_in_environment(environment, selected, arguments.trials, store)
        for row, backend in selected:
            if not _print_result(row, backend, store):
                not_met.append(f"{row.name} on {backend}")
    if arguments.write:
        from verification.faults.page import write_page

        print(write_page(store))
    print(f"not met: {', '.join(not_met)}" if not_met else "every row that was run is met")
    return 1 if not_met else 0


def _select_measurements(
    row_names: Sequence[str], only_backends: Sequence[str] | None
) -> list[Measurement]:
    """Return each named row with each backend on which to measure it.

    Args:
        row_names: Names of the rows.
        only_backends: Backends on which to measure. None or empty: all to which a row applies.
    """
    measurements: list[Measurement] = []
    for name in row_names:
        row = ROWS[name]
        for backend in row.list_backends():
            if not only_backends or backend in only_backends:
                measurements.append((row, backend))
    return measurements


def _measure_row(row: FaultRow, backend: Backend, trial_count: int) -> RowResult:
    """Measure a row on a backend. An exception ends the measurement, and becomes a part of the result."""
    measure = row.get_measure(backend)
    assert measure is not None, f"{row.name} does not apply to {backend}"
    if trial_count >= TRIALS:
        trial_count = max(trial_count, row.min_trials)
    start_s = time.monotonic()
    load = _read_load()
    trials: list[InjectionTrial] = []
    broken = ""
    print(f"{datetime.now():%H:%M:%S} {row.name} on {backend} ...", flush=True)
    with tempfile.TemporaryDirectory(prefix=f"snakesim-{row.name}-") as folder:
        request = MeasurementRequest(backend, trial_count, Path(folder), [])
        try:
            for trial in measure(request):
                trials.append(trial)
                if trial.failure:
                    print(f"    {trial.failure}", flush=True)
        except Exception as error:  # noqa: BLE001 - an exception is a result, and the other rows continue
            _print_error(error, Path(folder))
            broken = f"{type(error).__name__}: {error}"[:MAX_STORED_ERROR_CHARACTERS]
    return _make_result(
        row,
        backend,
        took_s=round(time.monotonic() - start_s, 1),
        load=load,
        trials=trials,
        retried=request.retried,
        notes=request.notes,
        broken=broken,
    )


def _measure_in_environment(
    environment: Environment,
    measurements: Sequence[Measurement],
    trial_count: int,
    store: FaultResults,
) -> None:
    """Measure rows with a process in another environment, which writes its results into the same file.

    A row without a new result gets one that names the environment as the reason.
    """
    results_before = store.read()
    command = [*ENVIRONMENT_COMMANDS[environment]]
    if environment == "guest":
        command += [*_make_writable_folder_options(store), "--"]
    command += ["env", f"{ENVIRONMENT_VARIABLE}={environment}"]
    command += [sys.executable, "-m", "verification.faults"]
    command += ["--rows", *dict.fromkeys(row.name for row, _ in measurements)]
    command += ["--backends", *dict.fromkeys(backend for _, backend in measurements)]
    command += ["--trials", str(trial_count), "--json", str(store.path)]
    try:
        subprocess.run(command, cwd=ROOT, check=False, timeout=ENVIRONMENT_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(f"    {error}", flush=True)

    results = store.read()
    for row, backend in measurements:
        key = (row.name, backend)
        if results.get(key) == results_before.get(key):
            reason = f"no result from the environment {environment!r}"
            store.save(_make_result(row, backend, broken=reason))


def _make_writable_folder_options(store: FaultResults) -> list[str]:
    """Return the options that let a guest write into the folder of the results, if it is not in the checkout."""
    folder = store.path.resolve().parent
    if folder.is_relative_to(ROOT):
        return []
    return ["--rwdir", str(folder)]


def _make_result(row: FaultRow, backend: Backend, **measured: Any) -> RowResult:
    """Return a result with the current time. measured: fields that differ from a result without trials."""
    values: dict[str, Any] = {"took_s": 0.0, "load": _read_load(), "trials": []}
    values |= measured
    return RowResult(
        row=row.name,
        backend=backend,
        when=f"{datetime.now():%Y-%m-%d %H:%M}",
        machine=describe_machine(),
        **values,
    )


def _read_load() -> float:
    """Return the load average of the machine over the last minute."""
    return round(os.getloadavg()[0], 2)


def _print_error(error: Exception, folder: Path) -> None:
    """Print where an exception was raised, and the end of every log in a folder."""
    traceback.print_tb(error.__traceback__)
    message = str(error)[:MAX_PRINTED_ERROR_CHARACTERS]
    print(f"{type(error).__name__}: {message}", file=sys.stderr)
    for log in folder.glob("*.log"):
        end = log.read_text(errors="replace")[-MAX_LOG_CHARACTERS:]
        print(f"{log.name}: {end}", file=sys.stderr)
    sys.stderr.flush()


def _print_result(row: FaultRow, backend: Backend, store: FaultResults) -> bool:
    """Print the stored result of a row. Return whether the row is met."""
    result = store.read()[row.name, backend]
    verdict = judge_row(row, result)
    figures = ""
    if verdict.median is not None:
        figures = f"median {verdict.median:.1f}, worst {verdict.worst:.1f} {row.unit}, "
    retried = f", {result.retried} retried" if result.retried else ""
    outcome = "met" if verdict.met else f"NOT MET: {verdict.reason}"
    trials = f"{len(result.trials)} trials{retried} in {result.took_s:.0f} s"
    print(f"    {row.name} on {backend}: {figures}{trials}: {outcome}", flush=True)
    return verdict.met


def _parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m verification.faults",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--rows",
        nargs="+",
        choices=list(ROWS),
        metavar="NAME",
        help=f"rows to measure (default: all): {', '.join(ROWS)}",
    )
    parser.add_argument(
        "--backends",
        nargs="+",
        choices=get_args(Backend),
        metavar="NAME",
        help="backends on which to measure (default: all to which a row applies)",
    )
    parser.add_argument(
        "--trials",
        type=int,
        default=TRIALS,
        help=f"number of trials of each row on each backend (default: {TRIALS})",
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
        help="file of the raw results (default: docs/benchmarks/faults.json)",
    )
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())

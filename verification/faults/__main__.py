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

from verification.faults.results import ROOT, Store, machine
from verification.faults.row import TRIALS, Backend, Request, Result, Row, Trial, judge
from verification.faults.table import ROWS

PLACE = "SNAKESIM_FAULTS_PLACE"  # where this process is, when it was started for a place
ELSEWHERE = {
    "namespaces": ["unshare", "--net", "--mount"],
    "guest": [sys.executable, str(ROOT / "deploy/vm/with_vcan.py"), "--guest"],
}
Job = tuple[Row, Backend]
ELSEWHERE_LIMIT_S = 2400.0


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the rows that are asked for, one after the other; those that need another place at the end, together."""
    given = _parsed(argv)
    store, inside = Store(given.json), os.environ.get(PLACE)
    rows = [ROWS[name] for name in given.rows or ROWS]
    wanted: list[Job] = [(row, backend) for row in rows for backend in _backends(row, given.backends)]
    failed: list[str] = []
    for row, backend in wanted:
        if row.place in ("here", inside):
            store.put(_measured(row, backend, given.trials))
            failed += _reported(row, backend, store)
    if inside is not None:
        return 0
    for place in ELSEWHERE:
        there = [job for job in wanted if job[0].place == place]
        if there:
            _elsewhere(place, there, given, store)
            failed += [name for row, backend in there for name in _reported(row, backend, store)]
    if given.write:
        from verification.faults.page import write

        print(write(store))
    print(f"not met: {', '.join(failed)}" if failed else "every row that was run is met")
    return 1 if failed else 0


def _backends(row: Row, only: Sequence[str] | None) -> list[Backend]:
    return [name for name, how in row.on.items() if not isinstance(how, str) and (not only or name in only)]


def _measured(row: Row, backend: Backend, trials: int) -> Result:
    """Run a row. What goes wrong is part of its result."""
    measure = row.on[backend]
    assert not isinstance(measure, str)
    started, load, done, broken = time.monotonic(), round(os.getloadavg()[0], 2), list[Trial](), ""
    wanted = max(trials, row.least) if trials >= TRIALS else trials
    print(f"{datetime.now():%H:%M:%S} {row.name} on {backend} ...", flush=True)
    with tempfile.TemporaryDirectory(prefix=f"snakesim-{row.name}-") as folder:
        request = Request(backend, wanted, Path(folder), [])
        try:
            for trial in measure(request):
                done.append(trial)
                if trial.failure:
                    print(f"    {trial.failure}", flush=True)
        except Exception as error:  # noqa: BLE001 - a row that breaks is a result, and the others go on
            traceback.print_tb(error.__traceback__)
            print(f"{type(error).__name__}: {str(error)[:1000]}", file=sys.stderr)
            logs = [f"{log.name}: {log.read_text(errors='replace')[-800:]}" for log in Path(folder).glob("*.log")]
            print("\n".join(logs), file=sys.stderr, flush=True)
            broken = f"{type(error).__name__}: {error}"[:500]
    took_s = round(time.monotonic() - started, 1)
    reported = {"trials": done, "retried": request.retried, "notes": request.notes, "broken": broken}
    return _result(row, backend, took_s=took_s, load=load, **reported)


def _elsewhere(place: str, wanted: Sequence[Job], given: argparse.Namespace, store: Store) -> None:
    """Run rows by a process in the place that they need; it writes into the same file."""
    before = store.read()
    names, backends = dict.fromkeys(row.name for row, _ in wanted), dict.fromkeys(backend for _, backend in wanted)
    enter = list(ELSEWHERE[place])
    if place == "guest":
        folder = store.path.resolve().parent
        enter += [*([] if folder.is_relative_to(ROOT) else ["--rwdir", str(folder)]), "--"]
    command = [sys.executable, "-m", "verification.faults", "--rows", *names, "--backends", *backends]
    command += ["--trials", str(given.trials), "--json", str(store.path)]
    try:
        subprocess.run([*enter, "env", f"{PLACE}={place}", *command], cwd=ROOT, check=False, timeout=ELSEWHERE_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(f"    {error}", flush=True)
    after = store.read()
    for row, backend in wanted:
        if after.get((row.name, backend)) == before.get((row.name, backend)):
            store.put(_result(row, backend, broken=f"nothing came back from the place that it needs ({place})"))


def _result(row: Row, backend: str, **measured: Any) -> Result:
    empty: dict[str, Any] = {"took_s": 0.0, "load": round(os.getloadavg()[0], 2), "trials": []}
    when = f"{datetime.now():%Y-%m-%d %H:%M}"
    return Result(row=row.name, backend=backend, when=when, machine=machine(), **(empty | measured))


def _reported(row: Row, backend: str, store: Store) -> list[str]:
    """Print how a row came out; its name when it is not met."""
    result = store.read()[row.name, backend]
    verdict = judge(row, result)
    figures = "" if verdict.median is None else f"median {verdict.median:.1f}, worst {verdict.worst:.1f} {row.unit}, "
    outcome = "met" if verdict.met else f"NOT MET: {verdict.why}"
    retried = f", {result.retried} retried" if result.retried else ""
    trials = f"{len(result.trials)} trials{retried} in {result.took_s:.0f} s"
    print(f"    {row.name} on {backend}: {figures}{trials}: {outcome}", flush=True)
    return [] if verdict.met else [f"{row.name} on {backend}"]


def _parsed(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m verification.faults", description=__doc__)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), metavar="NAME", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--backends", nargs="+", choices=get_args(Backend), metavar="NAME", help="only on these")
    parser.add_argument("--trials", type=int, default=TRIALS, help=f"of each row and backend ({TRIALS})")
    parser.add_argument(
        "--write", action="store_true", help="write docs/benchmarks/faults.md and docs/fault-table.csv from all results"
    )
    parser.add_argument("--json", type=Path, default=Store().path, help="raw results (docs/benchmarks/faults.json)")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())

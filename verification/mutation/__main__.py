"""`python -m verification.mutation`: try every mutant, print every survivor, and fail if one has no explanation."""

import argparse
import multiprocessing
import os
import tempfile
import time
import tomllib
from collections.abc import Iterator
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from verification.mutation import trial
from verification.mutation.mutants import SourceMutant, mutants_of

EQUIVALENT = Path(__file__).with_name("equivalent.toml")
FORK = multiprocessing.get_context("fork")


def main() -> int:
    """0 when every mutant was noticed or is explained."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--files", nargs="+", choices=list(trial.TRIED_BY), default=list(trial.TRIED_BY)
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--time-limit", type=float, default=120.0, help="seconds that one mutant may take"
    )
    asked = parser.parse_args()
    os.chdir(trial.ROOT)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    trial.warm_up()
    started = time.monotonic()
    sources = {file: (trial.ROOT / trial.place_of(file)).read_text() for file in asked.files}
    unchanged = [
        SourceMutant(file, "module", 0, "unchanged", source) for file, source in sources.items()
    ]
    for mutant, outcome in outcomes(iter(unchanged), asked.workers, asked.time_limit):
        if outcome != trial.SURVIVED:
            print(
                f"mutation: the tests of {mutant.file} fail without any mutation (pytest exit {outcome})"
            )
            return 2
    tried = killed = late = 0
    unexplained: list[SourceMutant] = []
    reasons = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))
    equivalent = {mutant for mutants in reasons.values() for mutant in mutants}
    explained: set[str] = set()
    every = (mutant for file, source in sources.items() for mutant in mutants_of(file, source))
    for mutant, outcome in outcomes(every, asked.workers, asked.time_limit):
        tried += 1
        key = f"{mutant.file} in {mutant.where}: {mutant.change}"
        if outcome != trial.SURVIVED:
            killed += 1
            late += outcome is None
        elif key in equivalent:
            explained.add(key)
        else:
            unexplained.append(mutant)
            print(f"survived: {mutant}", flush=True)
    stale = {key for key in equivalent if key.partition(" ")[0] in sources} - explained
    for key in sorted(stale):
        print(f"explained as equivalent, but there is no such survivor any more: {key}")
    print(
        f"{tried} mutants: {killed} killed ({late} by the time limit), {tried - killed - len(unexplained)} equivalent, "
        f"{len(unexplained)} survived; {time.monotonic() - started:.0f} s"
    )
    return 1 if unexplained or stale else 0


def outcomes(
    mutants: Iterator[SourceMutant], worker_count: int, limit_s: float
) -> Iterator[tuple[SourceMutant, int | None]]:
    """Pytest's exit code for each mutant; None for one that had to be stopped."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        running: list[tuple[SourceMutant, BaseProcess, float]] = []
        more = True
        while more or running:
            while more and len(running) < worker_count:
                mutant = next(mutants, None)
                more = mutant is not None
                if mutant is not None:
                    process = FORK.Process(
                        target=trial.run, args=(mutant.file, mutant.source, folder)
                    )
                    process.start()
                    running.append((mutant, process, time.monotonic() + limit_s))
            wait([process.sentinel for _, process, _ in running], timeout=1.0)
            for entry in running[:]:
                mutant, process, deadline = entry
                if process.is_alive() and time.monotonic() < deadline:
                    continue
                process.kill()  # without effect on one that has ended
                process.join()
                code = process.exitcode
                (Path(folder) / f"{process.pid}.log").unlink(missing_ok=True)
                running.remove(entry)
                if (
                    code not in (trial.SURVIVED, trial.KILLED, trial.BROKEN_AT_IMPORT)
                    and code != -9
                ):
                    raise SystemExit(f"mutation: pytest ended with {code} on {mutant}")
                yield mutant, None if code == -9 else code


if __name__ == "__main__":
    raise SystemExit(main())
